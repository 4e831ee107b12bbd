/** Rows of a list moved by mouse, pen or finger. */

import { calm } from "./dom.js";

/**
 * Call `moved(from, to)` when a row was let go: equal where it was only pressed, or the drag was broken off.
 *
 * The row follows the pointer, and the others make room.
 */
export function dragging(list, moved) {
  list.addEventListener("pointerdown", (event) => {
    const row = event.target.closest("li");
    const held =
      row && !event.target.closest("button") && (event.pointerType === "mouse" || event.target.closest(".rank-grip"));
    if (!held || event.button !== 0) return;
    event.preventDefault();
    follow(list, row, event, moved);
  });
}

function follow(list, row, start, moved) {
  const from = [...list.children].indexOf(row);
  const grip = start.clientY - row.getBoundingClientRect().top;
  row.classList.add("dragged");
  row.setPointerCapture(start.pointerId);

  const move = (event) => {
    row.style.transform = "";
    makeRoom(list, row, event.clientY);
    row.style.transform = `translateY(${event.clientY - grip - row.getBoundingClientRect().top}px)`;
  };
  const end = (event) => {
    row.removeEventListener("pointermove", move);
    row.removeEventListener("pointerup", end);
    row.removeEventListener("pointercancel", end);
    row.classList.remove("dragged");
    row.style.transform = "";
    const to = [...list.children].indexOf(row);
    moved(from, event.type === "pointerup" ? to : from);
  };
  row.addEventListener("pointermove", move);
  row.addEventListener("pointerup", end);
  row.addEventListener("pointercancel", end);
}

/** Neighbours hop over the row, which itself stays in the page: taking it out would lose the pointer. */
function makeRoom(list, row, y) {
  const middle = (node) => node.getBoundingClientRect().top + node.offsetHeight / 2;
  while (row.previousElementSibling && y < middle(row.previousElementSibling)) {
    hop(row.previousElementSibling, () => row.after(row.previousElementSibling));
  }
  while (row.nextElementSibling && y > middle(row.nextElementSibling)) {
    hop(row.nextElementSibling, () => row.before(row.nextElementSibling));
  }
}

function hop(node, change) {
  const before = node.getBoundingClientRect().top;
  change();
  const passed = before - node.getBoundingClientRect().top;
  if (!calm())
    node.animate([{ transform: `translateY(${passed}px)` }, { transform: "none" }], {
      duration: 140,
      easing: "ease-out",
    });
}

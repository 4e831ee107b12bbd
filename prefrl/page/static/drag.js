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

/** Along which way the rows stand: on a small screen they are in one line. */
const DOWN = { at: "clientY", edge: "top", size: "offsetHeight", slide: "translateY" };
const ALONG = { at: "clientX", edge: "left", size: "offsetWidth", slide: "translateX" };

function follow(list, row, start, moved) {
  const way = getComputedStyle(list).gridAutoFlow.startsWith("column") ? ALONG : DOWN;
  const from = [...list.children].indexOf(row);
  const grip = start[way.at] - row.getBoundingClientRect()[way.edge];
  row.classList.add("dragged");
  row.setPointerCapture(start.pointerId);

  const move = (event) => {
    row.style.transform = "";
    makeRoom(list, row, event[way.at], way);
    row.style.transform = `${way.slide}(${event[way.at] - grip - row.getBoundingClientRect()[way.edge]}px)`;
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
function makeRoom(list, row, place, way) {
  const middle = (node) => node.getBoundingClientRect()[way.edge] + node[way.size] / 2;
  while (row.previousElementSibling && place < middle(row.previousElementSibling)) {
    hop(row.previousElementSibling, way, () => row.after(row.previousElementSibling));
  }
  while (row.nextElementSibling && place > middle(row.nextElementSibling)) {
    hop(row.nextElementSibling, way, () => row.before(row.nextElementSibling));
  }
}

function hop(node, way, change) {
  const before = node.getBoundingClientRect()[way.edge];
  change();
  const passed = before - node.getBoundingClientRect()[way.edge];
  if (!calm())
    node.animate([{ transform: `${way.slide}(${passed}px)` }, { transform: "none" }], {
      duration: 140,
      easing: "ease-out",
    });
}

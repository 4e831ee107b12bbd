/** Three to eight candidates put in order, best first, with ties: by dragging, by buttons, or by keys. */

import { calm, el, icon, iconButton, put } from "./dom.js";
import { dragging } from "./drag.js";
import { snippet } from "./textview.js";
import { t } from "./strings.js";

/** An order of slots; `tied` means as good as the one above. */
export class Order {
  touched = false;
  selected = -1;

  /** `ranks`, one for each slot, where there is an earlier answer. */
  constructor(count, ranks = null) {
    const slots = Array.from({ length: count }, (_, slot) => slot);
    if (ranks) slots.sort((a, b) => ranks[a] - ranks[b] || a - b);
    this.rows = slots.map((slot, at) => ({
      slot,
      tied: Boolean(ranks) && at > 0 && ranks[slot] === ranks[slots[at - 1]],
    }));
  }

  /** Rank by slot: 0 is best, and equal ones are ties. */
  get ranks() {
    const ranks = Array(this.rows.length);
    let rank = -1;
    for (const row of this.rows) {
      if (!row.tied) rank += 1;
      ranks[row.slot] = rank;
    }
    return ranks;
  }

  /** Put the row at `from` where `to` is. It leaves its tie behind, and so does what was tied to it. */
  move(from, to) {
    if (to < 0 || to >= this.rows.length || from === to) return;
    const [row] = this.rows.splice(from, 1);
    const next = this.rows[from];
    if (next && !row.tied) next.tied = false;
    row.tied = false;
    this.rows.splice(to, 0, row);
    this.rows[0].tied = false;
    this.selected = to;
    this.touched = true;
  }

  /** The same, and the row is the chosen one from now on. */
  place(from, to) {
    this.selected = from;
    this.move(from, to);
  }

  /** Make the row as good as the one above, or better again. */
  tie(at) {
    if (at <= 0) return;
    this.rows[at].tied = !this.rows[at].tied;
    this.touched = true;
  }
}

/** The list, its buttons and its keys: {element, actions, digit}. `submit(order, event)` is called with an answer. */
export class Ranking {
  #rows = new Map();
  #list = el("ol", { class: "rank-list", testid: "rank-list", "aria-label": t("rank.list") });
  #say = el("p", { class: "sr-only", role: "status" });
  #warning = el("p", { class: "rank-warning", role: "alert", hidden: true, text: t("rank.untouched") });
  #send = el(
    "button",
    { type: "button", class: "primary", testid: "submit-ranking", data: { action: "submit" } },
    el("span", { text: t("rank.submit") }),
    el("kbd"),
  );
  #warned = false;
  #submit;
  #look;

  /** `clips`, where there are any, lend each row a small moving picture; `look(slot)` brings a candidate into sight. */
  constructor(items, submit, ranks = null, { clips = [], look = () => {} } = {}) {
    this.order = new Order(items.length, ranks);
    this.#submit = submit;
    this.#look = look;
    items.forEach((item) => this.#rows.set(item.slot, this.#row(item, clips[item.slot])));
    this.#send.addEventListener("click", (event) => this.submit(event));
    this.element = el(
      "section",
      { class: "ranking", "aria-labelledby": "rank-title" },
      el("h2", { id: "rank-title", text: t("rank.title") }),
      el("p", { class: "hint", text: t("rank.hint") }),
      this.#list,
      el("p", { class: "tap", text: t("rank.tap") }),
      this.#warning,
      this.#say,
      this.#send,
    );
    dragging(this.#list, (from, to) => this.#act(() => this.order.place(from, to)));
    this.#list.addEventListener("click", (event) => {
      const row = event.target.closest("li");
      if (row && !event.target.closest("button")) this.digit(Number(row.dataset.slot));
    });
    this.#draw();
  }

  get actions() {
    const by = (step) => () => this.#act(() => this.#shift(step));
    return {
      up: by(-1),
      down: by(1),
      level: () => this.#act(() => this.order.tie(this.order.selected)),
      submit: (event) => this.submit(event),
    };
  }

  /** Choose the candidate with this number, so that the keys move it. */
  digit = (slot) => {
    const at = this.order.rows.findIndex((row) => row.slot === slot);
    if (at < 0) return;
    this.order.selected = at;
    this.#draw();
    this.#rows.get(slot).element.scrollIntoView({ block: "nearest", behavior: calm() ? "auto" : "smooth" });
    this.#look(slot);
  };

  /** Send it; an order that nobody touched needs a second press. */
  submit(event) {
    if (!this.order.touched && !this.#warned) {
      this.#warned = true;
      this.#warning.hidden = false;
      this.#send.firstChild.textContent = t("rank.submit.untouched");
      return;
    }
    this.#submit(this.order, event);
  }

  set disabled(off) {
    this.#send.disabled = off;
  }

  /** With nothing chosen yet, the first press of an arrow chooses. */
  #shift(step) {
    const { order } = this;
    if (order.selected < 0) order.selected = step > 0 ? 0 : order.rows.length - 1;
    else order.move(order.selected, order.selected + step);
  }

  #act(change) {
    change();
    this.#warning.hidden = true;
    this.#draw();
    const row = this.order.rows[this.order.selected];
    if (row) this.#say.textContent = t("rank.said", { slot: row.slot + 1, rank: this.order.ranks[row.slot] + 1 });
  }

  #row(item, clip) {
    const at = () => this.order.rows.findIndex((row) => row.slot === item.slot);
    const button = (name, key, change) =>
      iconButton(name, t(key, { slot: item.slot + 1 }), {
        testid: `rank-${name}-${item.slot}`,
        on: { click: () => this.#act(change) },
      });
    const place = el("span", { class: "rank-place" });
    const tie = button("equal", "rank.tie", () => this.order.tie(at()));
    const up = button("up", "rank.up", () => this.order.move(at(), at() - 1));
    const down = button("down", "rank.down", () => this.order.move(at(), at() + 1));
    const element = el(
      "li",
      { class: "rank-row", data: { slot: String(item.slot), testid: `rank-row-${item.slot}` } },
      el("span", { class: "rank-grip", "aria-hidden": "true" }, icon("grip")),
      place,
      el("span", { class: "badge", data: { slot: String(item.slot) }, text: String(item.slot + 1) }),
      clip ? small(clip) : el("span", { class: "rank-name" }, snippet(item.text ?? "")),
      el("span", { class: "rank-buttons" }, tie, up, down),
    );
    return { element, place, tie, up, down };
  }

  #draw() {
    const focused = document.activeElement;
    const elements = this.order.rows.map(({ slot }) => this.#rows.get(slot).element);
    if (elements.some((element, at) => element !== this.#list.children[at])) put(this.#list, ...elements);
    const { ranks } = this.order;
    this.order.rows.forEach((row, at) => {
      const { element, place, tie, up, down } = this.#rows.get(row.slot);
      element.classList.toggle("selected", at === this.order.selected);
      element.classList.toggle("tied", row.tied);
      place.textContent = String(ranks[row.slot] + 1);
      tie.setAttribute("aria-pressed", String(row.tied));
      tie.disabled = at === 0;
      up.disabled = at === 0;
      down.disabled = at === this.order.rows.length - 1;
    });
    if (focused && this.#list.contains(focused) && focused !== document.activeElement) focused.focus();
  }
}

function small(clip) {
  const canvas = el("canvas", { class: "rank-picture", width: "96", height: "72", "aria-hidden": "true" });
  clip.addEventListener("seen", () => clip.draw(canvas));
  clip.ready.then(() => clip.draw(canvas));
  return canvas;
}

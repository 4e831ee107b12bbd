/** What can be done at a step, to choose from: buttons for discrete actions, a slider for each dimension of others. */

import { el } from "./dom.js";
import { t } from "./strings.js";

/** Steps of an arrow key from one end of a slider to the other. */
const NOTCHES = 20;

/** The dimensions of an action with their ranges; one without an end gets room for twice what the policy did. */
export function dimensions(choices, actions) {
  if (choices.discrete) return [];
  return choices.names.map((name, at) => {
    const most = 2 * Math.max(0.5, ...actions.map((row) => Math.abs(row[at])));
    const [low, high] = [choices.low[at] ?? -most, choices.high[at] ?? most];
    return { name: name || t("act.dimension", { number: at + 1 }), low, high };
  });
}

/** Discrete actions. `choose(row)` is called with one. */
export class Choices {
  #buttons;

  constructor(names, choose) {
    this.#buttons = names.map((name, at) => {
      const key = at < 9 ? String(at + 1) : "";
      const node = el(
        "button",
        {
          type: "button",
          class: "move",
          testid: `move-${at}`,
          "aria-pressed": "false",
          "aria-keyshortcuts": key || null,
        },
        key ? el("kbd", { text: key }) : null,
        el("span", { class: "move-name", text: name || t("act.action", { number: at + 1 }) }),
        el("span", { class: "move-policy", text: t("act.policy") }),
      );
      node.addEventListener("click", () => choose([at]));
      return node;
    });
  }

  arranged(tracks) {
    const list = el("div", { class: "move-list", role: "group", "aria-label": t("act.moves") }, this.#buttons);
    return el("div", { class: "moves discrete" }, tracks, list);
  }

  pick(number) {
    return number < this.#buttons.length ? [number] : null;
  }

  /** The next action, or the one before; there is no end to go to. */
  changed([number], by) {
    const next = number - Math.sign(by) * (Number.isFinite(by) ? 1 : this.#buttons.length);
    return [Math.min(this.#buttons.length - 1, Math.max(0, next))];
  }

  show([number], [own], said) {
    this.#buttons.forEach((node, at) => {
      node.setAttribute("aria-pressed", String(said && at === number));
      node.classList.toggle("policys", at === own);
    });
  }
}

/** Sliders, one of which the arrow keys change. `choose(row)` is called with all their numbers. */
export class Sliders {
  #ranges;
  #fields;
  #chosen = 0;

  constructor(ranges, choose) {
    this.#ranges = ranges;
    this.#fields = ranges.map(({ name, low, high }, at) => {
      const slider = el("input", {
        type: "range",
        class: "slider",
        min: String(low),
        max: String(high),
        step: "any",
        testid: `slider-${at}`,
        "aria-label": name,
      });
      slider.addEventListener("input", () => {
        this.#select(at);
        const moved = this.#round(at, Number(slider.value));
        choose(this.#fields.map((field, other) => (other === at ? moved : field.value)));
      });
      slider.addEventListener("focus", () => this.#select(at));
      slider.addEventListener("pointerup", () => slider.blur());
      const [yours, policy] = [el("output", { class: "slider-yours" }), el("span", { class: "slider-policy" })];
      return { slider, value: 0, yours, policy };
    });
  }

  arranged(tracks) {
    const several = this.#ranges.length > 1;
    this.rows = this.#ranges.map(({ name }, at) => {
      const { slider, yours, policy } = this.#fields[at];
      const caption = several && at < 9 ? el("kbd", { text: String(at + 1) }) : null;
      const label = el("span", { class: "slider-name", text: name });
      const head = el("div", { class: "slider-head" }, caption, label, policy, yours);
      const row = el("div", { class: "slider-row", testid: `dimension-${at}` }, head, tracks[at], slider);
      row.addEventListener("pointerdown", () => this.#select(at));
      return row;
    });
    this.#select(0);
    const sort = this.#ranges.length > 4 ? "moves crowded" : "moves";
    return el("div", { class: sort, data: { count: String(this.#ranges.length) } }, this.rows);
  }

  pick(number) {
    this.#select(number);
    return null;
  }

  changed(row, by) {
    const { low, high } = this.#ranges[this.#chosen];
    const goal = row[this.#chosen] + (Number.isFinite(by) ? (by * (high - low)) / NOTCHES : by);
    return row.map((number, at) => (at === this.#chosen ? this.#round(at, goal) : number));
  }

  show(row, own, said) {
    this.#fields.forEach((field, at) => {
      field.value = row[at];
      field.slider.value = String(row[at]);
      field.slider.classList.toggle("unsaid", !said);
      field.yours.textContent = said ? short(row[at]) : "–";
      field.policy.textContent = t("act.did", { value: short(own[at]) });
      field.slider.setAttribute("aria-valuetext", said ? short(row[at]) : t("act.unsaid", { value: short(row[at]) }));
    });
  }

  #select(at) {
    if (at >= this.#ranges.length) return;
    this.#chosen = at;
    if (this.rows.length > 4) this.rows[at].scrollIntoView({ block: "nearest" });
    this.rows.forEach((row, other) => row.classList.toggle("selected", other === at && this.rows.length > 1));
  }

  /** Never beyond its ends, whatever rounding does. */
  #round(at, number) {
    const { low, high } = this.#ranges[at];
    const places = 10 ** Math.max(0, 3 - Math.floor(Math.log10(high - low || 1)));
    return Math.min(high, Math.max(low, Math.round(number * places) / places));
  }
}

function short(number) {
  return number.toFixed(2).replace("-", "−");
}

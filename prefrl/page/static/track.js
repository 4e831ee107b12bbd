/** One dimension over the steps of a clip: what the policy did, what a person says, and where the clip is. */

import { el, svg } from "./dom.js";

/** Units of a step across, and of the whole range down; the drawing is stretched to its place. */
const WIDE = 10;
const HIGH = 100;
/** Left free above and below the range. */
const EDGE = 9;

export class Track {
  #low;
  #high;
  #steps;
  #joined;
  #policy = line("track-policy");
  #yours = line("track-yours");
  #agreed = line("track-agreed");
  #dots = line("track-dots");
  #open = svg("rect", { class: "track-open", y: "0", height: String(HIGH) });
  #cursor = svg("rect", { class: "track-cursor", y: "0", width: String(WIDE), height: String(HIGH) });

  /** Of numbers from `low` to `high`, or of so many `choices`, from top to bottom; `seek(step)` is called by clicks. */
  constructor({ steps, choices = 0, low = -0.5, high = choices - 0.5, seek }) {
    this.#low = low;
    this.#high = high;
    this.#steps = steps;
    this.#joined = !choices;
    const levels = choices ? Array.from({ length: choices }, (_, at) => at) : [(low + high) / 2];
    const across = (level) => `M0 ${this.#y(level)}H${steps * WIDE}`;
    const rules = levels.map((level) => svg("path", { class: "track-rule", d: across(level) }));
    const looks = choices ? "track choices-track" : "track";
    const box = `0 0 ${steps * WIDE} ${HIGH}`;
    const drawing = svg(
      "svg",
      { class: looks, viewBox: box, preserveAspectRatio: "none", "aria-hidden": "true" },
      rules,
      this.#open,
      this.#cursor,
      this.#policy,
      this.#agreed,
      this.#yours,
      this.#dots,
    );
    const labels = choices ? levels.map((level) => this.#label(level)) : [];
    this.element = el("div", { class: "track-box" }, drawing, labels);
    const go = (event) => {
      const box = drawing.getBoundingClientRect();
      seek(Math.min(steps - 1, Math.max(0, Math.floor((steps * (event.clientX - box.left)) / box.width))));
    };
    drawing.addEventListener("pointerdown", (event) => {
      drawing.setPointerCapture(event.pointerId);
      go(event);
    });
    drawing.addEventListener("pointermove", (event) => drawing.hasPointerCapture(event.pointerId) && go(event));
  }

  /** Show where the clip is. */
  move(step) {
    this.#cursor.setAttribute("x", String(step * WIDE));
  }

  /** Draw a plan's numbers in dimension `at`. */
  draw(plan, at) {
    const every = Array.from({ length: this.#steps }, (_, step) => step);
    const said = (step) => plan.at(step);
    const own = (step) => plan.own(step)[at];
    const agreed = every.filter((step) => said(step) === null);
    this.#policy.setAttribute("d", this.#path(every, own));
    this.#agreed.setAttribute("d", this.#path(agreed, own));
    this.#yours.setAttribute("d", this.#path(every.filter(said), (step) => said(step)[at]));
    const dots = plan.steps.map((step) => `M${(step + 0.5) * WIDE} ${this.#y(plan.row(step)[at])}h0`);
    this.#dots.setAttribute("d", dots.join(""));
    this.#open.setAttribute("width", String(plan.missing * WIDE));
  }

  /** The number of a choice, at its height. */
  #label(level) {
    const node = el("span", { class: "track-label", "aria-hidden": "true", text: String(level + 1) });
    node.style.top = `${this.#y(level)}%`;
    return node;
  }

  #path(steps, value) {
    const parts = steps.map((step, at) => {
      const y = this.#y(value(step));
      const on = this.#joined && steps[at - 1] === step - 1;
      return `${on ? `V${y}` : `M${step * WIDE} ${y}`}H${(step + 1) * WIDE}`;
    });
    return parts.join("");
  }

  #y(value) {
    const share = (value - this.#low) / (this.#high - this.#low || 1);
    const y = this.#joined ? EDGE + (HIGH - 2 * EDGE) * (1 - share) : HIGH * share;
    return Math.round(10 * Math.min(HIGH, Math.max(0, y))) / 10;
  }
}

function line(name) {
  return svg("path", { class: name, "vector-effect": "non-scaling-stroke" });
}

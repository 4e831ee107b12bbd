/** What is to be done at each step of a clip. What is set at a step holds until the next one that is set. */

/** Set at a step: what the policy did is right from there on. */
export const OWN = null;

/** Rows of numbers, one for each dimension, or of the number of a discrete action alone. */
export class Plan {
  #own;
  #set = new Map();

  /** `own` is what the policy did; `earlier` a plan as it was sent, or as `draft` gives it. */
  constructor(own, earlier = null) {
    this.#own = own;
    const rows = earlier?.actions;
    if (!Array.isArray(rows) || rows.length !== own.length) return;
    const first = earlier.missing ?? 0;
    rows.forEach((row, at) => at >= first && (at === first || !same(row, rows[at - 1])) && this.#set.set(at, row));
  }

  get length() {
    return this.#own.length;
  }

  /** The steps at which something was set, in order. */
  get steps() {
    return [...this.#set.keys()].sort((a, b) => a - b);
  }

  /** The step that says what holds at this one; -1 where nothing does yet. */
  source(step) {
    return this.steps.filter((one) => one <= step).at(-1) ?? -1;
  }

  /** What holds at a step: a row, `OWN`, or undefined where nothing was said yet. */
  at(step) {
    return this.#set.get(this.source(step));
  }

  /** The same as numbers: those of the policy where nothing else was said. */
  row(step) {
    return this.at(step) ?? this.#own[step];
  }

  /** What the policy did. */
  own(step) {
    return this.#own[step];
  }

  set(step, row) {
    this.#set.set(step, row);
  }

  /** Forget what holds at a step; what was set before it holds again. */
  clear(step) {
    this.#set.delete(this.source(step));
  }

  /** How many steps, from the first one on, nothing was said of. */
  get missing() {
    return this.steps[0] ?? this.length;
  }

  /** As the server wants it. */
  get rows() {
    return this.#own.map((_, step) => this.at(step));
  }

  /** As it is kept before it is sent; null where nothing was said yet. */
  get draft() {
    return this.missing < this.length ? { actions: this.rows, missing: this.missing } : null;
  }
}

function same(a, b) {
  return a === b || (a !== OWN && b !== OWN && a.every((number, at) => number === b[at]));
}

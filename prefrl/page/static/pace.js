/** How a sitting goes: how many, how fast, how long still, and when a break would do good. */

/** Away for this long counts as a break. */
const AWAY = 5 * 60_000;
/** A pause between two answers that is still work. */
const LONGEST = 3 * 60_000;
const MINUTE = 60_000;

/** Counts from when the page was opened. */
export class Pace {
  count = 0;
  #worked = 0;
  #since = performance.now();
  #last = performance.now();

  /** An answer was given. */
  answered() {
    const now = performance.now();
    const passed = now - this.#last;
    if (passed > AWAY) this.#since = now;
    this.#worked += Math.min(passed, LONGEST);
    this.#last = now;
    this.count += 1;
  }

  /** An answer was taken back. */
  undone() {
    this.count = Math.max(0, this.count - 1);
  }

  /** Answers an hour, or null while there are too few to tell. */
  get hourly() {
    return this.count < 3 || this.#worked < 1000 ? null : (this.count / this.#worked) * 60 * MINUTE;
  }

  /** Minutes for so many more, or null. */
  left(waiting) {
    return this.hourly && waiting > 0 ? (60 * waiting) / this.hourly : null;
  }

  /** True once after so many minutes without a break; asked at each answer. */
  tired(minutes) {
    if (!minutes || performance.now() - this.#since < minutes * MINUTE) return false;
    this.#since = performance.now();
    return true;
  }
}

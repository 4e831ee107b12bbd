/** Time on one question: on a visible tab, on a hidden one, and from when it could be answered. */
export class Stopwatch {
  #spent = { visible: 0, hidden: 0, deciding: 0 };
  #last = performance.now();
  #ready = false;
  #turn = () => this.#count(!document.hidden);

  constructor() {
    document.addEventListener("visibilitychange", this.#turn);
  }

  /** From now on an answer would be taken. */
  ready() {
    this.#count(document.hidden);
    this.#ready = true;
  }

  /** Milliseconds so far, as the server wants them; deciding counts visible time only. */
  read() {
    this.#count(document.hidden);
    const { visible, hidden, deciding } = this.#spent;
    return { visible_ms: visible, hidden_ms: hidden, decision_ms: deciding };
  }

  stop() {
    document.removeEventListener("visibilitychange", this.#turn);
  }

  /** `hidden` is how the tab was until now. */
  #count(hidden) {
    const now = performance.now();
    const passed = now - this.#last;
    this.#last = now;
    this.#spent[hidden ? "hidden" : "visible"] += passed;
    if (this.#ready && !hidden) this.#spent.deciding += passed;
  }
}

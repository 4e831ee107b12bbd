/** The questions a person holds: the one that is shown, and a few fetched ahead. */

import { Failed, post } from "./api.js";

/** As many as the server lends to one person: enough to go on for a while without a connection. */
const WANT = 6;

/** Events: `change` when the first question, or the reason for there being none, is another one. */
export class Desk extends EventTarget {
  held = [];
  reason = null;
  error = null;
  #answered = new Set();
  #fetching = null;
  #channel = "BroadcastChannel" in globalThis ? new BroadcastChannel("prefrl") : null;

  #sent;

  /** `sent()` gives the questions to which an answer is on its way already. */
  constructor(sent) {
    super();
    this.#sent = sent;
    if (this.#channel) this.#channel.onmessage = (message) => this.#elsewhere(message.data);
  }

  get current() {
    return this.held[0] ?? null;
  }

  /** The ids whose leases are to be kept. */
  get ids() {
    return this.held.map((one) => one.assignment_id);
  }

  /** This question is answered: go on to the next one. */
  finish(id) {
    this.#answered.add(id);
    this.#remove(id);
    this.#channel?.postMessage({ answered: id });
  }

  /** Put a question that was taken back in front of the others. */
  reopen(assignment) {
    this.#answered.delete(assignment.assignment_id);
    this.#channel?.postMessage({ reopened: assignment.assignment_id });
    this.held = [assignment, ...this.held.filter((one) => one.assignment_id !== assignment.assignment_id)];
    this.reason = null;
    this.#changed();
  }

  /** Fetch more where there is room; calls at the same time share one request. */
  refill() {
    this.#fetching ??= this.#fetch().finally(() => {
      this.#fetching = null;
    });
    return this.#fetching;
  }

  async #fetch() {
    const before = this.#showing();
    const sent = this.#sent(); // an answer may overtake this request, and be gone from there when it is done
    try {
      const { assignments, reason } = await post("/api/assignments", { want: WANT });
      const done = new Set([...sent, ...this.#sent(), ...this.#answered]);
      this.#merge(assignments.filter(({ assignment_id: id }) => !done.has(id)));
      this.reason = this.held.length ? null : reason;
      this.error = null;
    } catch (error) {
      if (!(error instanceof Failed)) throw error;
      this.error = error;
    }
    if (this.#showing() !== before || !this.held.length) this.#changed();
  }

  /** The question on show stays first: nothing is pulled away from under a person who is thinking. */
  #merge(fresh) {
    const shown = this.current;
    this.held = shown ? [shown, ...fresh.filter((one) => one.assignment_id !== shown.assignment_id)] : fresh;
  }

  #elsewhere({ answered, reopened }) {
    if (reopened) this.#answered.delete(reopened);
    if (!answered) return;
    this.#answered.add(answered);
    if (this.current?.assignment_id === answered) this.dispatchEvent(new Event("elsewhere"));
    this.#remove(answered);
  }

  #remove(id) {
    const first = this.current?.assignment_id === id;
    this.held = this.held.filter((one) => one.assignment_id !== id);
    if (first) this.#changed();
  }

  #showing() {
    return `${this.current?.assignment_id} ${this.reason} ${this.error?.status}`;
  }

  #changed() {
    this.dispatchEvent(new Event("change"));
  }
}

/**
 * Answers on their way: kept in this browser first, then sent, and dropped only with the server's receipt.
 *
 * Each item carries the id that was made for it here, so sending it twice stores it once.
 */

import { Failed, post } from "./api.js";
import { guarded, openDepot } from "./depot.js";

const FIRST_WAIT = 1000;
const LONGEST_WAIT = 30000;

/** Events: `change`; `receipt` and `refused` with `detail` {item, receipt | error}; `signedout`. */
export class Outbox extends EventTarget {
  items = [];
  #depot = null;
  #who = "";
  #store = "";
  #sending = false;
  #wait = 0;
  #timer = 0;
  #ever = false;

  /** Take up what an earlier page left behind, and go on sending it. One address may serve different stores in turn. */
  async start(who, store) {
    this.#who = who;
    this.#store = store;
    this.#depot ??= guarded(await openDepot());
    const mine = (item) => item.who === who && item.store === store;
    const kept = (await this.#depot.all()).filter((item) => mine(item) && !this.#has(item.id));
    // What another page kept may have been sent by it; what was kept for other people or stores waits for their links.
    const older = kept.sort((a, b) => a.at - b.at).map((item) => ({ ...item, tries: item.tries + 1 }));
    this.items = [...older, ...this.items.filter(mine)];
    this.#changed();
    this.hurry();
  }

  /** File something under `path`; it is held from now on, and sent as soon as it is kept. */
  add(path, body) {
    const sender = { who: this.#who, store: this.#store };
    const item = { id: body.submission_id, path, body, ...sender, at: Date.now(), refused: "", tries: 0 };
    this.items.push(item);
    this.#changed();
    this.#depot.put(item).then(() => this.hurry());
    return item;
  }

  /** Take an item back before it was ever sent; false where it may have reached the server. */
  async withdraw(id) {
    const item = this.items.find((one) => one.id === id);
    if (!item || item.tries) return false;
    await this.#drop(item);
    return true;
  }

  /** Forget an item that the server refused. */
  async dismiss(id) {
    const item = this.items.find((one) => one.id === id && one.refused);
    if (item) await this.#drop(item);
  }

  /** Questions of which the last thing on its way is an answer: the server may still call them open. */
  get answering() {
    const found = new Set();
    for (const { path, body } of this.unsent) {
      if (path === "/api/answers") found.add(body.assignment_id);
      if (path === "/api/undo") found.delete(body.assignment_id);
    }
    return found;
  }

  get unsent() {
    return this.items.filter((item) => !item.refused);
  }

  get refused() {
    return this.items.filter((item) => item.refused);
  }

  /** "saved" is said only when everything has the server's receipt. */
  get state() {
    if (this.unsent.length) return this.#wait ? "offline" : "saving";
    if (this.refused.length) return "refused";
    return this.#ever ? "saved" : "idle";
  }

  /** Done when nothing is on its way any more, or with false after `limit` milliseconds. */
  settle(limit) {
    return new Promise((resolve) => {
      const timer = setTimeout(() => done(false), limit);
      const done = (outcome) => {
        clearTimeout(timer);
        this.removeEventListener("change", look);
        resolve(outcome);
      };
      const look = () => this.unsent.length || done(true);
      this.addEventListener("change", look);
      look();
    });
  }

  /** Try now, whatever wait was under way. */
  hurry() {
    clearTimeout(this.#timer);
    if (!this.#sending) this.#send();
  }

  async #send() {
    this.#sending = true;
    try {
      for (let item = this.unsent[0]; item; item = this.unsent[0]) await this.#post(item);
    } catch (error) {
      this.#fail(error);
    } finally {
      this.#sending = false;
    }
  }

  async #post(item) {
    item.tries += 1;
    try {
      const receipt = await post(item.path, item.body);
      this.#wait = 0;
      this.#ever = true;
      await this.#drop(item);
      this.#tell("receipt", { item, receipt });
    } catch (error) {
      if (!(error instanceof Failed) || error.passing || error.status === 401) throw error;
      item.refused = error.message;
      await this.#depot.put(item);
      this.#changed();
      this.#tell("refused", { item, error });
    }
  }

  #fail(error) {
    if (error.status === 401) this.dispatchEvent(new Event("signedout"));
    this.#wait = Math.min(LONGEST_WAIT, Math.max(FIRST_WAIT, this.#wait * 2));
    const wait = Math.max(this.#wait, (error.retryAfter ?? 0) * 1000) * (1 + Math.random() / 4);
    this.#timer = setTimeout(() => this.hurry(), wait);
    this.#changed();
  }

  async #drop(item) {
    this.items = this.items.filter((one) => one !== item);
    await this.#depot.remove(item.id);
    this.#changed();
  }

  #has(id) {
    return this.items.some((item) => item.id === id);
  }

  #tell(name, detail) {
    this.dispatchEvent(new CustomEvent(name, { detail }));
  }

  #changed() {
    this.dispatchEvent(new Event("change"));
  }
}

/** Who is here, and how the project stands: asked for every two seconds while the page is looked at. */

import { call, Failed, get, post } from "./api.js";

const OFTEN = 2000;
const SELDOM = 15000;

/** Events: `state` at each answer, `offline` when there is none, `signedout`. */
export class Session extends EventTarget {
  me = null;
  state = null;
  online = true;
  #timer = 0;
  #seq = 0;
  #misses = 0;
  /** The link's, until the server has said yes or no to it. */
  #token = "";

  /** Sign in with the link's token if there is one, and find out who this is. Raises `Failed`; may be tried again. */
  async open() {
    this.#token = takeToken() || this.#token;
    try {
      this.me = this.#token ? await enter(this.#token) : await get("/api/me");
    } catch (error) {
      if (!error.passing) this.#token = "";
      throw error;
    }
    this.#token = "";
    this.state = {
      seq: 0,
      progress: this.me.progress,
      guideline: this.me.guideline,
      consent: this.me.consent,
      paused: false,
      read_only: false,
      finished: false,
    };
    this.#timer ||= setTimeout(() => this.poll(), 0);
    return this.me;
  }

  async leave() {
    await call("DELETE", "/api/session").catch(() => undefined);
    this.#end();
  }

  /** Ask now. */
  async poll() {
    clearTimeout(this.#timer);
    try {
      const state = await get(`/api/state?since=${this.#seq}`);
      if (state) this.#take(state);
      this.#misses = 0;
      this.#connected(true);
    } catch (error) {
      if (!(error instanceof Failed)) throw error;
      if (error.status === 401) return this.#end();
      this.#misses += 1;
      if (error.passing) this.#connected(false);
    }
    const wait = document.hidden ? SELDOM : Math.min(SELDOM, OFTEN * 2 ** this.#misses);
    this.#timer = setTimeout(() => this.poll(), wait);
    return undefined;
  }

  #take(state) {
    this.#seq = state.seq;
    this.state = state;
    this.dispatchEvent(new Event("state"));
  }

  #connected(online) {
    if (online === this.online) return;
    this.online = online;
    this.dispatchEvent(new Event(online ? "online" : "offline"));
  }

  #end() {
    clearTimeout(this.#timer);
    this.#timer = 0;
    this.me = null;
    this.dispatchEvent(new Event("signedout"));
  }
}

/** An old link opened again must not shut out who is signed in already. */
async function enter(token) {
  try {
    return await post("/api/session", { token });
  } catch (error) {
    if (error.status !== 401) throw error;
    return get("/api/me");
  }
}

/** The token in the address's fragment, taken out of the address at once: it must not stay in the history. */
function takeToken() {
  const token = decode(location.hash.slice(1));
  if (!token) return "";
  history.replaceState(null, "", location.pathname + location.search);
  return token;
}

function decode(text) {
  try {
    return decodeURIComponent(text).trim();
  } catch {
    return text.trim();
  }
}

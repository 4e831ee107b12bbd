/** Calls to the server; whatever goes wrong comes out as one kind of error. */

import { t } from "./strings.js";

const TIMEOUT = 20000;

/** What went wrong: `status` is 0 where no answer came, and `retryAfter` is in seconds. */
export class Failed extends Error {
  constructor(status, message, retryAfter = 0) {
    super(message);
    this.status = status;
    this.retryAfter = retryAfter;
  }

  /** True where the same call may well succeed later. */
  get passing() {
    return this.status === 0 || this.status === 408 || this.status === 429 || this.status >= 500;
  }
}

/** Send JSON, get JSON; `null` for an empty or unchanged answer. Raises `Failed`. */
export async function call(method, path, body) {
  const abort = new AbortController();
  const timer = setTimeout(() => abort.abort(), TIMEOUT);
  try {
    return await read(await fetch(path, request(method, body, abort.signal)));
  } catch (error) {
    if (error instanceof Failed) throw error;
    throw new Failed(0, t("error.offline"));
  } finally {
    clearTimeout(timer);
  }
}

export const get = (path) => call("GET", path);
export const post = (path, body) => call("POST", path, body ?? {});

/** Get a file: {blob, about}, with what the server says of it. Raises `Failed`. There is no limit on the time. */
export async function getFile(path) {
  const response = await fetch(path, request("GET")).catch(() => {
    throw new Failed(0, t("error.offline"));
  });
  if (!response.ok) await read(response);
  return { blob: await response.blob(), about: JSON.parse(response.headers.get("Prefrl-About")) };
}

function request(method, body, signal) {
  const settings = { method, signal, credentials: "same-origin", cache: "no-cache", redirect: "error" };
  if (body === undefined) return settings;
  return { ...settings, headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) };
}

async function read(response) {
  if (response.status === 204 || response.status === 304) return null;
  const text = await response.text();
  const content = parsed(text);
  if (response.ok && content !== undefined) return content;
  const said = typeof content?.error === "string" ? content.error : t("error.status", { status: response.status });
  throw new Failed(response.status, said, Number(response.headers.get("Retry-After")) || 0);
}

function parsed(text) {
  try {
    return JSON.parse(text);
  } catch {
    return undefined;
  }
}

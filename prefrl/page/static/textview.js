/** A prompt and its responses: the prompt stays in sight, the responses stand side by side or one below the other. */

import { compare } from "./diff.js";
import { el, isolate, put, toggle } from "./dom.js";
import { cut, FIRST, LongText } from "./longtext.js";
import { settings } from "./settings.js";
import { t } from "./strings.js";

/** The prompt's panel, or nothing. */
export function promptView(prompt) {
  if (prompt === null || prompt === undefined) return null;
  const text = new LongText(prompt, { class: "long-text prompt-text" });
  text.show({ invisible: settings.get("invisible") });
  const stop = settings.watch((name) => name === "invisible" && text.show({ invisible: settings.get("invisible") }));
  const element = el(
    "section",
    { class: "prompt", testid: "prompt", "aria-label": t("text.prompt"), tabindex: "0" },
    el("h2", { class: "overline", text: t("text.prompt") }),
    text.element,
  );
  return { element, close: stop };
}

/** The responses of an assignment, each to be put into a slot: {elements, toolbar, close}. */
export class Responses {
  #texts;
  #raw;
  #note = el("span", { class: "diff-note", role: "status" });
  #stop;
  #compared = null;

  constructor(items, page) {
    this.#raw = items.map((item) => item.text ?? "");
    this.#texts = this.#raw.map((text) => new LongText(text));
    this.elements = this.#texts.map((text, at) => this.#panel(text, at));
    this.toolbar = this.#tools(page, items.length);
    this.#stop = settings.watch(() => this.#show(page));
    this.#show(page);
  }

  close() {
    this.#stop();
  }

  #panel(text, at) {
    const panel = el(
      "div",
      {
        class: "response",
        testid: `response-${at}`,
        tabindex: "0",
        role: "region",
        "aria-label": t("text.response", { slot: at + 1 }),
      },
      text.element,
    );
    panel.addEventListener("scroll", () => this.#link(panel), { passive: true });
    return panel;
  }

  #show(page) {
    const diff = settings.get("diff") && this.#raw.length === 2 ? this.#difference() : null;
    this.#texts.forEach((text, at) =>
      text.show({
        markdown: page.markdown && settings.get("markdown"),
        invisible: settings.get("invisible"),
        length: settings.get("length"),
        runs: diff && [diff.first, diff.second][at],
      }),
    );
    put(this.#note, diff && !diff.whole ? t("text.diff.part") : "");
  }

  /** Made once, when it is first asked for. */
  #difference() {
    if (!this.#compared) {
      const [a, b] = this.#raw.map((text) => cut(text, FIRST));
      const found = compare(a, b);
      const short = a.length < this.#raw[0].length || b.length < this.#raw[1].length;
      this.#compared = { ...found, whole: found.whole && !short };
    }
    return this.#compared;
  }

  /** Where scrolling is linked, the others go to the same share of their own length. */
  #link(moved) {
    if (!settings.get("linked") || this.linking === moved) {
      this.linking = null;
      return;
    }
    const share = moved.scrollTop / Math.max(1, moved.scrollHeight - moved.clientHeight);
    for (const panel of this.elements) {
      const goal = Math.round(share * (panel.scrollHeight - panel.clientHeight));
      if (panel === moved || Math.abs(panel.scrollTop - goal) < 2) continue;
      this.linking = panel;
      panel.scrollTop = goal;
    }
  }

  #tools(page, count) {
    const item = (name, key, testid) =>
      toggle(t(key), settings.get(name), (on) => settings.set(name, on), { "data-testid": testid });
    return el(
      "div",
      { class: "text-tools", role: "toolbar", "aria-label": t("text.tools") },
      item("stacked", "text.stacked", "toggle-stacked"),
      item("linked", "text.linked", "toggle-linked"),
      page.markdown ? item("markdown", "text.markdown", "toggle-markdown") : null,
      count === 2 ? item("diff", "text.diff", "toggle-diff") : null,
      item("invisible", "text.invisible", "toggle-invisible"),
      item("length", "text.lengths", "toggle-length"),
      this.#note,
    );
  }
}

/** A short, harmless piece of a response, for lists. */
export function snippet(text, length = 90) {
  const line = cut(
    text
      .slice(0, 4 * length)
      .replace(/\s+/g, " ")
      .trim(),
    length,
  );
  return isolate(line + (line.length < text.trim().length ? "…" : ""));
}

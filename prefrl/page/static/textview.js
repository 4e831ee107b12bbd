/** A prompt and its responses: the prompt stays in sight, the responses stand side by side or one below the other. */

import { compare } from "./diff.js";
import { el, isolate, put, toggle } from "./dom.js";
import { cut, FIRST, LongText } from "./longtext.js";
import { settings } from "./settings.js";
import { t } from "./strings.js";
import { CUE, turns } from "./turns.js";

/** Whether Markdown and turns are drawn: where the project has it, and the person did not ask for what was written. */
function drawn(page) {
  return page.markdown && !settings.get("written");
}

/** The prompt's panel, or nothing. */
export function promptView(prompt, page) {
  if (prompt === null || prompt === undefined) return null;
  const text = new LongText(prompt, { class: "long-text prompt-text" });
  const show = () => text.show({ drawn: drawn(page), invisible: settings.get("invisible") });
  show();
  const stop = settings.watch((name) => ["invisible", "written", ""].includes(name) && show());
  const element = el(
    "section",
    { class: "prompt", testid: "prompt", "aria-label": t("text.prompt"), tabindex: "0" },
    el("h2", { class: "overline", text: t("text.prompt") }),
    text.element,
  );
  /** Of a conversation the last turn is what was answered. */
  const begin = () => {
    if (page.markdown && turns(prompt)) element.scrollTop = element.scrollHeight;
  };
  return { element, begin, close: stop };
}

/** The responses of an assignment, each to be put into a slot: {elements, toolbar, close}. */
export class Responses {
  #texts;
  #raw;
  #note = el("span", { class: "diff-note", role: "status" });
  #stop;
  #compared = null;
  #marks = null;
  #shown = [];

  /** `prompt` is what they answer. */
  constructor(items, page, prompt) {
    this.#raw = items.map((item) => item.text ?? "");
    const cue = prompt && turns(prompt) ? CUE : "";
    this.#texts = this.#raw.map((text) => new LongText(text, {}, cue));
    this.elements = this.#texts.map((text, at) => this.#panel(text, at));
    this.toolbar = this.#tools(page, items.length);
    this.#stop = settings.watch(() => this.#show(page));
    this.#show(page);
  }

  close() {
    this.#stop();
  }

  /** Show from now on which parts of the first response are gone in another text. */
  mark(runs, page) {
    this.#marks = runs.some((run) => run.alone) ? [runs] : null;
    this.#show(page);
  }

  /** What keys do here. */
  get actions() {
    return { written: () => settings.set("written", !settings.get("written")) };
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
        drawn: drawn(page),
        invisible: settings.get("invisible"),
        length: settings.get("length"),
        runs: diff ? [diff.first, diff.second][at] : this.#marks?.[at],
      }),
    );
    this.#shown.forEach((show) => show());
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
    const item = (name, key, testid, action) => {
      const label = action ? [t(key), el("kbd")] : t(key);
      const props = { testid, class: `toggle ${name}`, data: action ? { action } : {} };
      const node = toggle(label, settings.get(name), (on) => settings.set(name, on), props);
      this.#shown.push(() => node.setAttribute("aria-pressed", String(settings.get(name))));
      return node;
    };
    return el(
      "div",
      { class: "text-tools", role: "toolbar", "aria-label": t("text.tools") },
      count > 1 ? item("stacked", "text.stacked", "toggle-stacked") : null,
      count > 1 ? item("linked", "text.linked", "toggle-linked") : null,
      page.markdown ? item("written", "text.written", "toggle-written", "written") : null,
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

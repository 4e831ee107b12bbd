/** One text in a panel: drawn, as written, with hidden characters shown, or compared; long ones a part at a time. */

import { el, put } from "./dom.js";
import { countHidden, revealed } from "./invisible.js";
import { formatted } from "./markdown.js";
import { t } from "./strings.js";
import { bubbles, turns } from "./turns.js";

/** Characters shown at first. */
export const FIRST = 20_000;
/** Characters that are drawn as Markdown and turns: hostile ones take a quarter of a second. */
const DRAWN = 2 * FIRST;
/** Characters in a block that the browser lays out only when it comes into sight. */
const BLOCK = 16_000;

const number = new Intl.NumberFormat("en");

/** A text that can be shown in several ways; `show({drawn, invisible, length, runs})` chooses. */
export class LongText {
  #text;
  #cue;
  #body = el("div", { class: "text-body", dir: "auto" });
  #foot = el("div", { class: "text-foot" });
  #whole = false;
  #way = {};

  /** `cue`: what a conversation says before this text begins. */
  constructor(text, props = {}, cue = "") {
    this.#text = text;
    this.#cue = cue;
    this.element = el("div", { class: "long-text", ...props }, this.#body, this.#foot);
  }

  show(way) {
    this.#way = way;
    const part = this.#whole ? this.#text : cut(this.#text, FIRST);
    const drawn = way.drawn && !way.runs && !way.invisible && part.length <= DRAWN ? this.#drawn(part) : null;
    this.#body.classList.toggle("rendered", Boolean(drawn));
    put(this.#body, ...(drawn ?? this.#nodes(part, way)));
    put(this.#foot, this.#length(way.length), this.#hidden(way), this.#rest(part.length));
    this.#foot.hidden = !this.#foot.childNodes.length;
  }

  /** Turns and Markdown as nodes; null for a text that has neither, which looks best as it was written. */
  #drawn(part) {
    const said = turns(this.#cue + part);
    if (!said || (this.#cue && said.length === 1)) return formatted(part);
    const draw = (content) => {
      const nodes = formatted(content);
      return el("div", { class: nodes ? "turn-text" : "turn-text written", dir: "auto" }, nodes ?? content);
    };
    return bubbles(said, draw, !this.#cue);
  }

  #nodes(part, { invisible, runs }) {
    if (!this.#text) return [el("p", { class: "empty", text: t("text.empty") })];
    if (runs)
      return runs
        .map((run) =>
          run.alone
            ? el("mark", { class: "alone" }, shown(run.text, invisible, false))
            : shown(run.text, invisible, false),
        )
        .flat();
    if (part.length <= FIRST) return shown(part, invisible);
    return blocks(part).map((block) => el("div", { class: "text-block", dir: "auto" }, shown(block, invisible, false)));
  }

  #length(wanted) {
    if (!wanted) return null;
    const characters = number.format(
      Array.from(this.#text.slice(0, FIRST)).length + Math.max(0, this.#text.length - FIRST),
    );
    const count = number.format(
      this.#text
        .slice(0, 50 * FIRST)
        .split(/\s+/)
        .filter(Boolean).length,
    );
    return el("span", { class: "length", text: t("text.length", { characters, words: count }) });
  }

  #hidden({ invisible }) {
    const count = invisible ? 0 : countHidden(this.#text.slice(0, FIRST));
    return count
      ? el("span", { class: "hidden-note", text: t(count === 1 ? "text.hidden.one" : "text.hidden", { count }) })
      : null;
  }

  #rest(length) {
    const left = this.#text.length - length;
    if (left <= 0) return null;
    const all = el("button", {
      type: "button",
      class: "link",
      testid: "show-all",
      text: t("text.all", { left: number.format(left) }),
    });
    all.addEventListener("click", () => {
      this.#whole = true;
      this.show(this.#way);
    });
    return all;
  }
}

/** The beginning of a text, at a character's border. */
export function cut(text, length) {
  if (text.length <= length) return text;
  const split = text.charCodeAt(length - 1);
  return text.slice(0, split >= 0xd800 && split <= 0xdbff ? length - 1 : length);
}

function shown(text, invisible, whole = true) {
  return invisible ? revealed(text, whole) : [text];
}

/** Pieces of a long text, parted at line ends where there are any. */
function blocks(text) {
  const out = [];
  for (let at = 0; at < text.length;) {
    const part = cut(text.slice(at, at + BLOCK + 1), BLOCK);
    const line = part.lastIndexOf("\n");
    const taken = at + part.length >= text.length || line < BLOCK / 4 ? part : part.slice(0, line + 1);
    out.push(taken.endsWith("\n") ? taken.slice(0, -1) : taken);
    at += taken.length;
  }
  return out;
}

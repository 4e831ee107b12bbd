/** Characters that cannot be seen, or that turn the order of others round, shown as what they are. */

import { el } from "./dom.js";

const NAMES = {
  "\u00ad": "SHY",
  "\u034f": "CGJ",
  "\u061c": "ALM",
  "\u180e": "MVS",
  "\u200b": "ZWSP",
  "\u200c": "ZWNJ",
  "\u200d": "ZWJ",
  "\u200e": "LRM",
  "\u200f": "RLM",
  "\u202a": "LRE",
  "\u202b": "RLE",
  "\u202c": "PDF",
  "\u202d": "LRO",
  "\u202e": "RLO",
  "\u2060": "WJ",
  "\u2061": "FA",
  "\u2062": "IT",
  "\u2063": "IS",
  "\u2064": "IP",
  "\u2066": "LRI",
  "\u2067": "RLI",
  "\u2068": "FSI",
  "\u2069": "PDI",
  "\ufeff": "BOM",
  "\u2028": "LSEP",
  "\u2029": "PSEP",
  "\u00a0": "NBSP",
  "\u202f": "NNBSP",
  "\u3000": "IDSP",
};

/** Control characters; formatting and bidirectional marks; odd spaces; private use; tags. */
const HIDDEN = [
  /[\u0000-\u0008\u000b-\u001f\u007f-\u009f]/u,
  /[\u00ad\u034f\u061c\u180e\u200b-\u200f\u2028-\u202e\u2060-\u2069\ufeff]/u,
  /[\u00a0\u2000-\u200a\u202f\u205f\u3000]/u,
  /[\ue000-\uf8ff]|[\u{e0000}-\u{e007f}]/u,
];
const ANY = HIDDEN.map((one) => one.source).join("|");
const EVERY = new RegExp(ANY, "gu");
const SHOWN = new RegExp(`${ANY}|\\n|\\t|(?<! ) +(?=\\n)`, "gu");
const SHOWN_AT_END = new RegExp(`${SHOWN.source}|(?<! ) +$`, "gu");

/** How many such characters there are, up to 999; line breaks and ordinary spaces do not count. */
export function countHidden(text) {
  let count = 0;
  for (const _ of text.matchAll(EVERY)) if (++count === 999) break;
  return count;
}

/** Nodes of a text with each such character as a small label; `whole` where the text ends with this piece. */
export function revealed(text, whole = true) {
  const nodes = [];
  let last = 0;
  for (const match of text.matchAll(whole ? SHOWN_AT_END : SHOWN)) {
    nodes.push(text.slice(last, match.index), mark(match[0]));
    last = match.index + match[0].length;
  }
  return [...nodes, text.slice(last)];
}

function mark(found) {
  const sign = { "\n": "¶", "\t": "→" }[found];
  if (sign) return el("span", { class: "mark" }, el("span", { "aria-hidden": "true", text: sign }), found);
  if (found.startsWith(" ")) return el("span", { class: "mark space", text: "·".repeat(found.length) });
  const code = found.codePointAt(0).toString(16).toUpperCase().padStart(4, "0");
  return el("span", { class: "mark hidden-char", title: `U+${code}`, text: NAMES[found] ?? `U+${code}` });
}

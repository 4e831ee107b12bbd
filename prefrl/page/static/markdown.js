/**
 * A small and safe part of Markdown: headings, lists, quotes, code, tables, rules, bold, italic, struck out.
 *
 * It makes nodes, never markup. There are no images, no HTML and no links to click: an address is shown as text.
 * Nothing that was written is left out but the signs of Markdown themselves.
 */

import { el } from "./dom.js";

/**
 * Code, bold, bold, italic, italic, link, struck out, a sign that is meant as such.
 *
 * Spans have a longest length, and no pattern can match one text in many ways: hostile text costs no more than any
 * other.
 */
const SPANS = [
  /(?<!`)(`{1,3})(?!`)([\s\S]{0,1000}?[^`])\1(?!`)/u,
  /\*\*(?=\S)([\s\S]{0,400}?\S)\*\*/u,
  /__(?=\S)([\s\S]{0,400}?\S)__/u,
  /\*(?=[^\s*])([^*]*?[^\s*])\*/u,
  /(?<![\p{L}\p{N}])_(?=[^\s_])([^_]*?[^\s_])_(?![\p{L}\p{N}])/u,
  /!?\[([^\]\n]{0,500})\]\(([^)\s]{0,2000})\)/u,
  /~~(?=\S)([\s\S]{0,400}?\S)~~/u,
  /\\([*_`#])/u,
];
const INLINE = new RegExp(SPANS.map((one) => one.source).join("|"), "gu");
const FENCE = /^(\s{0,8})(```+|~~~+)([^\n]*)$/;
const HEADING = /^(#{1,6})[ \t]+(\S[^\n]*)$/;
const RULE = /^\s{0,3}([-*_])(\s*\1){2,}\s*$/;
const BULLET = /^(\s{0,8})(?:[-*+]|(\d{1,9})[.)])[ \t]+([^\n]*)$/;
const QUOTE = /^\s{0,3}>[ \t]?([^\n]*)$/;
const DASHES = /^\s*:?-+:?\s*$/;
/** Quotes in quotes, and spans in spans. */
const DEEP = 6;
const NESTED = 2;

/** A text as nodes, or null where there is no Markdown in it: such a text is best shown as it was written. */
export function formatted(text) {
  const nodes = markdown(text);
  return nodes.every((node) => node.localName === "p" && !node.firstElementChild) ? null : nodes;
}

/** A text as nodes. */
export function markdown(text, depth = 0) {
  const lines = text.split("\n");
  const out = [];
  let at = 0;
  while (at < lines.length) {
    const [node, next] = block(lines, at, depth);
    if (node) out.push(node);
    at = next;
  }
  return out;
}

function block(lines, at, depth) {
  const line = lines[at];
  if (!line.trim()) return [null, at + 1];
  if (FENCE.test(line)) return fence(lines, at);
  const heading = HEADING.exec(line);
  if (heading)
    return [el(`h${Math.min(6, heading[1].length + 1)}`, { dir: "auto" }, inline(heading[2].trimEnd())), at + 1];
  if (RULE.test(line)) return [el("hr"), at + 1];
  if (QUOTE.test(line) && depth < DEEP) return quote(lines, at, depth);
  if (BULLET.test(line)) return list(lines, at);
  if (starts(lines, at)) return table(lines, at);
  return paragraph(lines, at);
}

/**
 * What stands behind the opening fence, a language mostly, is shown, and a closing one has nothing behind it: text
 * could hide there.
 */
function fence(lines, at) {
  const [, indent, mark, info] = FENCE.exec(lines[at]);
  let end = at + 1;
  const close = new RegExp(`^\\s{0,8}${mark[0]}{${mark.length},}\\s*$`);
  while (end < lines.length && !close.test(lines[end])) end += 1;
  const code = lines.slice(at + 1, end).map((line) => (line.startsWith(indent) ? line.slice(indent.length) : line));
  return [
    el(
      "div",
      { class: "code" },
      info.trim() ? el("div", { class: "code-name", text: info.trim() }) : null,
      el("pre", { class: "wide", tabindex: "0" }, el("code", { text: code.join("\n") })),
    ),
    end + 1,
  ];
}

/** Whether a table starts here: a row, and a line of dashes with as many cells. */
function starts(lines, at) {
  if (at + 1 >= lines.length || !lines[at].includes("|") || !lines[at + 1].includes("-")) return false;
  const dashes = cells(lines[at + 1]);
  return dashes.every((cell) => DASHES.test(cell)) && dashes.length === cells(lines[at]).length;
}

function cells(line) {
  return line
    .trim()
    .replace(/^\|/, "")
    .replace(/(?<!\\)\|$/, "")
    .split(/(?<!\\)\|/);
}

function table(lines, at) {
  let end = at + 2;
  while (end < lines.length && lines[end].includes("|")) end += 1;
  const row = (line, cell) =>
    el(
      "tr",
      {},
      cells(line).map((text) => el(cell, { dir: "auto" }, inline(text.trim().replaceAll("\\|", "|")))),
    );
  const body = lines.slice(at + 2, end).map((line) => row(line, "td"));
  return [
    el(
      "div",
      { class: "table wide", tabindex: "0" },
      el("table", {}, el("thead", {}, row(lines[at], "th")), el("tbody", {}, body)),
    ),
    end,
  ];
}

function quote(lines, at, depth) {
  let end = at;
  while (end < lines.length && QUOTE.test(lines[end])) end += 1;
  const inner = lines
    .slice(at, end)
    .map((line) => QUOTE.exec(line)[1])
    .join("\n");
  return [el("blockquote", { dir: "auto" }, markdown(inner, depth + 1)), end];
}

/** Deeper items are indented, not nested: a judge needs the look, not the tree. Numbers are those that were written. */
function list(lines, at) {
  const node = el(BULLET.exec(lines[at])[2] === undefined ? "ul" : "ol");
  let end = at;
  for (; end < lines.length; end++) {
    const item = BULLET.exec(lines[end]);
    if (item)
      node.append(
        el(
          "li",
          {
            dir: "auto",
            class: `depth-${Math.min(3, Math.floor(item[1].length / 2))} ${item[2] ? "numbered" : "bulleted"}`,
            ...(item[2] ? { value: item[2] } : {}),
          },
          inline(item[3]),
        ),
      );
    else if (/^\s{2,}\S/.test(lines[end])) node.lastChild.append(" ", ...inline(lines[end].trim()));
    else break;
  }
  return [node, end];
}

function paragraph(lines, at) {
  let end = at + 1;
  const stop = (line) =>
    !line.trim() || FENCE.test(line) || HEADING.test(line) || BULLET.test(line) || QUOTE.test(line);
  while (end < lines.length && !stop(lines[end]) && !starts(lines, end)) end += 1;
  return [el("p", { dir: "auto" }, inline(lines.slice(at, end).join("\n"))), end];
}

function inline(text, depth = 0) {
  if (depth > NESTED) return [text];
  const nodes = [];
  let last = 0;
  for (const match of text.matchAll(INLINE)) {
    nodes.push(text.slice(last, match.index), span(match, depth + 1));
    last = match.index + match[0].length;
  }
  return [...nodes, text.slice(last)];
}

function span([, , code, strong, strong2, slanted, slanted2, label, address, struck, sign], depth) {
  if (code !== undefined) return el("code", { text: code });
  if (strong ?? strong2) return el("strong", {}, inline(strong ?? strong2, depth));
  if (slanted ?? slanted2) return el("em", {}, inline(slanted ?? slanted2, depth));
  if (struck) return el("s", {}, inline(struck, depth));
  if (sign) return sign;
  return el("span", { class: "address" }, el("span", { text: label }), el("code", { text: address }));
}

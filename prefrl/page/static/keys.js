/** Keys and what they do. Every key can be changed, and all can be switched off. */

import { settings } from "./settings.js";
import { t } from "./strings.js";

/** Actions and the keys they start with. A name is that of `KeyboardEvent.key`, with "Shift+" before it where held. */
export const ACTIONS = {
  first: ["ArrowLeft", "1"],
  second: ["ArrowRight", "2"],
  firstSlight: ["a"],
  secondSlight: ["d"],
  firstMuch: ["Shift+ArrowLeft"],
  secondMuch: ["Shift+ArrowRight"],
  tie: ["ArrowDown", "0"],
  up: ["ArrowUp"],
  down: ["ArrowDown"],
  level: ["t"],
  stepBack: ["ArrowLeft"],
  stepOn: ["ArrowRight"],
  more: ["ArrowUp"],
  less: ["ArrowDown"],
  most: ["Shift+ArrowUp"],
  least: ["Shift+ArrowDown"],
  own: ["p"],
  clear: ["Backspace", "Delete"],
  write: ["e"],
  submit: ["Enter"],
  incomparable: ["x"],
  skip: ["s"],
  undo: ["z"],
  play: ["Space"],
  replay: ["r"],
  back: [","],
  forward: ["."],
  slower: ["-"],
  faster: ["+", "="],
  written: ["w"],
  comment: ["c"],
  guideline: ["g"],
  help: ["?"],
};

/** Actions of one kind of question, which those of another never meet; all others are on every page. */
const PAGES = [
  new Set(["first", "second", "firstSlight", "secondSlight", "firstMuch", "secondMuch", "tie"]),
  new Set(["up", "down", "level", "submit"]),
  new Set(["stepBack", "stepOn", "more", "less", "most", "least", "own", "clear", "submit"]),
  new Set(["write"]),
];

function meet(one, other) {
  const [pages, others] = [one, other].map((action) => PAGES.filter((page) => page.has(action)));
  return !pages.length || !others.length || pages.some((page) => others.includes(page));
}

const SIGNS = {
  ArrowLeft: "←",
  ArrowRight: "→",
  ArrowUp: "↑",
  ArrowDown: "↓",
  Enter: "↵",
  Backspace: "⌫",
  "Shift+": "⇧",
};

/** The keys of an action now. */
export function bound(action) {
  return settings.get("bindings")[action] ?? ACTIONS[action];
}

/** The action that already has a key and would be confused with this one, or null. */
export function conflict(action, key) {
  const taken = (other) => other !== action && meet(action, other) && bound(other).includes(key);
  return Object.keys(ACTIONS).find(taken) ?? null;
}

/** The name of the key of an event: letters in lower case, "Shift+" only where it does not change the sign itself. */
export function keyName(event) {
  const key = event.key === " " ? "Space" : event.key;
  if (key.length > 1) return event.shiftKey ? `Shift+${key}` : key;
  const letter = key.toLowerCase() !== key.toUpperCase();
  return letter && event.shiftKey ? `Shift+${key.toLowerCase()}` : key.toLowerCase();
}

/** A key as it is printed on a key cap. */
export function sign(key) {
  if (key.startsWith("Shift+")) return SIGNS["Shift+"] + sign(key.slice(6));
  if (key === "Space") return t("key.space");
  return SIGNS[key] ?? (key.length === 1 ? key.toUpperCase() : key);
}

const WRITTEN = "input:not([type=range]):not([type=checkbox]):not([type=radio]), textarea, select, [contenteditable]";
const PRESSED = "button, a, summary, input[type=checkbox], input[type=radio]";

const SCROLLED = ".response, .prompt";
const WIDE = ".wide";

/** A table or code that was only clicked leaves its arrows to the answers. */
let pointed = false;
addEventListener("pointerdown", () => (pointed = true), true);
addEventListener("keydown", (event) => event.key === "Tab" && (pointed = false), true);

function scrolls(panel) {
  return panel !== null && panel.scrollHeight > panel.clientHeight + 1;
}

/** True where a key belongs to what has the focus: text being written, a slider, a long text, a button. */
function taken(event) {
  const target = event.target;
  if (!(target instanceof Element)) return false;
  if (target.closest(WRITTEN)) return true;
  if (target.closest("input[type=range]") && event.key.startsWith("Arrow")) return true;
  if (["ArrowUp", "ArrowDown"].includes(event.key) && scrolls(target.closest(SCROLLED))) return true;
  const wide = pointed ? null : target.closest(WIDE);
  if (["ArrowLeft", "ArrowRight"].includes(event.key) && wide && wide.scrollWidth > wide.clientWidth + 1) return true;
  return Boolean(target.closest(PRESSED)) && (event.key === " " || event.key === "Enter");
}

let scopes = [];

/**
 * Make actions do something until the result is called: `{action: (event) => ...}`; later scopes come first. One that
 * is marked `held` goes on while its key is held down; no answer may be given so.
 */
export function listen(handlers, digit = null) {
  const scope = { handlers, digit };
  scopes = [scope, ...scopes];
  return () => {
    scopes = scopes.filter((one) => one !== scope);
  };
}

function find(key) {
  for (const { handlers, digit } of scopes) {
    if (digit && /^[1-9]$/.test(key)) return () => digit(Number(key) - 1);
    const action = Object.keys(handlers).find((name) => bound(name).includes(key));
    if (action) return handlers[action];
  }
  return null;
}

addEventListener("keydown", (event) => {
  if (event.defaultPrevented || event.isComposing) return;
  if (event.ctrlKey || event.altKey || event.metaKey) return;
  if (!settings.get("keys") || document.querySelector("dialog[open]") || taken(event)) return;
  const handler = find(keyName(event));
  if (!handler || (event.repeat && !handler.held)) return;
  event.preventDefault();
  handler(event);
});

// A held key must neither answer again nor scroll the page under the next question.
addEventListener("keydown", (event) => {
  if (event.repeat && settings.get("keys") && !taken(event) && find(keyName(event))) event.preventDefault();
});

/** Write the key caps and `aria-keyshortcuts` of all buttons that name an action. */
export function cap(root = document) {
  const on = settings.get("keys");
  for (const node of root.querySelectorAll("[data-action]")) {
    const keys = on ? bound(node.dataset.action) : [];
    if (keys.length) node.setAttribute("aria-keyshortcuts", keys.map(spoken).join(" "));
    else node.removeAttribute("aria-keyshortcuts");
    const caps = node.querySelector("kbd");
    if (caps) {
      caps.textContent = keys.length ? sign(keys[0]) : "";
      caps.hidden = !keys.length;
    }
  }
}

/** As `aria-keyshortcuts` wants it: a plus sign has a name of its own. */
function spoken(key) {
  return key === "+" ? "Plus" : key;
}

settings.watch((name) => ["bindings", "keys", ""].includes(name) && cap());

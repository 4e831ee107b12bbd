/** Elements are made here, node by node: no markup is ever parsed, so no text can turn into markup. */

import { t } from "./strings.js";

const SVG = "http://www.w3.org/2000/svg";

/**
 * An element with its attributes and children.
 *
 * Special names in `props`: `text`, `testid`, `on` {event: handler}, `data` {name: value}; `true` sets an empty
 * attribute, and `false`, `null` and `undefined` leave it out. Children may be nodes, strings, or nothing.
 */
export function el(tag, props = {}, ...children) {
  return fill(document.createElement(tag), props, children);
}

/** The same for SVG. */
export function svg(tag, props = {}, ...children) {
  return fill(document.createElementNS(SVG, tag), props, children);
}

function fill(node, { text, testid, on = {}, data = {}, ...attributes }, children) {
  for (const [name, value] of Object.entries(attributes)) {
    if (value === true) node.setAttribute(name, "");
    else if (value !== false && value !== null && value !== undefined) node.setAttribute(name, value);
  }
  if (testid) node.dataset.testid = testid;
  for (const [name, value] of Object.entries(data)) node.dataset[name] = value;
  for (const [name, handler] of Object.entries(on)) node.addEventListener(name, handler);
  if (text !== undefined) node.textContent = text;
  node.append(...children.flat(Infinity).filter((child) => child !== null && child !== undefined && child !== false));
  return node;
}

/** Replace all that is in a node. */
export function put(node, ...children) {
  node.replaceChildren(...children.flat(Infinity).filter(Boolean));
  return node;
}

/** Strokes on a 24 x 24 grid. */
const ICONS = {
  check: ["M5 12.5l4.5 4.5L19 7.5"],
  cloudOff: ["M4 4l16 16", "M8.5 8.2A5 5 0 0 0 7 18h10", "M12 7.2a5 5 0 0 1 5 4.3 3.6 3.6 0 0 1 2.7 5.6"],
  spinner: ["M12 4a8 8 0 1 0 8 8"],
  warning: ["M12 4.5l8.5 15h-17z", "M12 10v4.5", "M12 17v.2"],
  play: ["M8 5.5v13l11-6.5z"],
  pause: ["M8.5 5.5v13", "M15.5 5.5v13"],
  replay: ["M5 12a7 7 0 1 0 2.3-5.2", "M5 4.5v4h4"],
  back: ["M16 6l-7 6 7 6z", "M6.5 6v12"],
  forward: ["M8 6l7 6-7 6z", "M17.5 6v12"],
  undo: ["M8.5 5.5L4.5 9.5l4 4", "M4.5 9.5H14a5 5 0 0 1 0 10h-4"],
  help: ["M9.2 9.2a2.9 2.9 0 1 1 4 2.7c-.8.4-1.2.9-1.2 2", "M12 17.2v.2", "M12 3.5a8.5 8.5 0 1 0 .01 0z"],
  gear: ["M4 7h9", "M17 7h3", "M4 17h3", "M11 17h9", "M15 5a2 2 0 1 0 .01 0z", "M9 15a2 2 0 1 0 .01 0z"],
  book: ["M5 5.5c3-1 5-.6 7 .9 2-1.5 4-1.9 7-.9v13c-3-1-5-.6-7 .9-2-1.5-4-1.9-7-.9z", "M12 6.4v13"],
  up: ["M6 14.5l6-6 6 6"],
  down: ["M6 9.5l6 6 6-6"],
  grip: ["M9 6v.2", "M15 6v.2", "M9 12v.2", "M15 12v.2", "M9 18v.2", "M15 18v.2"],
  comment: ["M4.5 5.5h15v10.5h-8l-4 3.5v-3.5h-3z"],
  flag: ["M6 20V4.5", "M6 5.5h11l-2 4 2 4H6"],
  equal: ["M6 9.5h12", "M6 14.5h12"],
  moon: ["M19 14.2A7.5 7.5 0 1 1 9.8 5a6 6 0 0 0 9.2 9.2z"],
  sun: [
    "M12 8a4 4 0 1 0 .01 0z",
    "M12 3v1.6",
    "M12 19.4V21",
    "M3 12h1.6",
    "M19.4 12H21",
    "M5.6 5.6l1.2 1.2",
    "M17.2 17.2l1.2 1.2",
    "M5.6 18.4l1.2-1.2",
    "M17.2 6.8l1.2-1.2",
  ],
  pen: ["M5 19l1-4.5L16.2 4.3l3.5 3.5L9.5 18z", "M13.7 6.8l3.5 3.5"],
  eye: ["M3.5 12c2.2-4 5-6 8.5-6s6.3 2 8.5 6c-2.2 4-5 6-8.5 6s-6.3-2-8.5-6z", "M12 9.4a2.6 2.6 0 1 0 .01 0z"],
  close: ["M6 6l12 12", "M18 6L6 18"],
  cup: ["M5 9h11v5a5 5 0 0 1-5 5h-1a5 5 0 0 1-5-5z", "M16 10.5h1.5a2.5 2.5 0 0 1 0 5H16", "M8 3.5v2", "M12 3.5v2"],
};

/** A drawn sign; it says nothing to a screen reader, so its button has a name of its own. */
export function icon(name) {
  const paths = ICONS[name].map((d) => svg("path", { d }));
  return svg(
    "svg",
    { class: `icon icon-${name}`, viewBox: "0 0 24 24", "aria-hidden": "true", focusable: "false" },
    paths,
  );
}

/** A button that shows only a sign. */
export function iconButton(name, label, { on, testid, action, ...more } = {}) {
  const data = action ? { action } : {};
  return el(
    "button",
    { type: "button", class: "icon-button", "aria-label": label, title: label, on, testid, data, ...more },
    icon(name),
  );
}

/** A modal dialog with a heading and a way out; it removes itself when closed. */
export function openDialog(title, body, { testid, wide = false, actions = [] } = {}) {
  const shut = iconButton("close", t("dialog.close"), { on: { click: () => dialog.close() } });
  const heading = el("h2", { text: title, id: "dialog-title" });
  const dialog = el(
    "dialog",
    { class: wide ? "dialog wide" : "dialog", testid, "aria-labelledby": "dialog-title" },
    el("header", { class: "dialog-head" }, heading, shut),
    el("div", { class: "dialog-body", tabindex: "0" }, body),
    actions.length ? el("footer", { class: "dialog-foot" }, actions) : null,
  );
  dialog.addEventListener("click", (event) => event.target === dialog && dialog.close());
  dialog.addEventListener("close", () => dialog.remove());
  document.body.append(dialog);
  dialog.showModal();
  return dialog;
}

/** True where a person asked for less motion. */
export function calm() {
  return matchMedia("(prefers-reduced-motion: reduce)").matches;
}

/** Text of unknown direction inside a sentence. */
export function isolate(text) {
  return el("bdi", { text });
}

/** A control that is on or off. */
export function toggle(label, on, change, props = {}) {
  const node = el("button", { type: "button", class: "toggle", "aria-pressed": String(on), ...props }, label);
  node.addEventListener("click", () => {
    const now = node.getAttribute("aria-pressed") !== "true";
    node.setAttribute("aria-pressed", String(now));
    change(now);
  });
  return node;
}

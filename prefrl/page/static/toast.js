/** Short messages at the lower edge; they go by themselves, and screen readers read them out. */

import { el, icon } from "./dom.js";

let shelf = null;

/** Say something for a while: `kind` is "note", "good" or "bad"; `button` is [label, what it does]. */
export function toast(text, { kind = "note", sign = null, button = null, seconds = 5, testid = "toast" } = {}) {
  shelf ??= document.body.appendChild(el("div", { class: "toasts", role: "status", "aria-live": "polite" }));
  const node = el("div", { class: `toast ${kind}`, testid }, sign ? icon(sign) : null, el("span", { text }));
  const go = () => node.remove();
  if (button)
    node.append(
      el("button", { type: "button", class: "link", text: button[0], on: { click: () => (go(), button[1]()) } }),
    );
  shelf.append(node);
  while (shelf.children.length > 3) shelf.firstChild.remove();
  setTimeout(go, seconds * 1000);
  return go;
}

/** The settings of this browser: colours, text size, autoplay, and every key. */

import { el, openDialog, put } from "./dom.js";
import { ACTIONS, bound, conflict, keyName, sign } from "./keys.js";
import { settings } from "./settings.js";
import { t } from "./strings.js";

/** The dialog; `leave` signs out. */
export function settingsDialog(leave) {
  const out = el("button", { type: "button", class: "secondary", text: t("settings.leave"), testid: "sign-out" });
  const dialog = openDialog(t("settings.title"), [looks(), keys()], {
    testid: "settings-dialog",
    wide: true,
    actions: [out],
  });
  out.addEventListener("click", () => {
    dialog.close();
    leave();
  });
}

function looks() {
  const themes = { auto: t("settings.theme.auto"), light: t("settings.theme.light"), dark: t("settings.theme.dark") };
  const sizes = { small: t("settings.size.small"), medium: t("settings.size.medium"), large: t("settings.size.large") };
  return el(
    "div",
    { class: "settings-grid" },
    picker("theme", t("settings.theme"), themes),
    picker("size", t("settings.size"), sizes),
    check("autoplay", t("settings.autoplay")),
    check("keys", t("settings.keys")),
  );
}

function picker(name, label, options) {
  const field = el(
    "select",
    { testid: `setting-${name}` },
    Object.entries(options).map(([value, text]) => el("option", { value, text })),
  );
  field.value = settings.get(name);
  field.addEventListener("change", () => settings.set(name, field.value));
  return el("label", { class: "field" }, el("span", { text: label }), field);
}

function check(name, label) {
  const field = el("input", { type: "checkbox", testid: `setting-${name}` });
  field.checked = settings.get(name);
  field.addEventListener("change", () => settings.set(name, field.checked));
  return el("label", { class: "field check" }, field, el("span", { text: label }));
}

function keys() {
  const note = el("p", { class: "key-note", role: "status" });
  const rows = el("div", { class: "key-rows" });
  const draw = () => put(rows, ...Object.keys(ACTIONS).map((action) => keyRow(action, note, draw)));
  const reset = el("button", { type: "button", class: "link", text: t("settings.reset"), testid: "reset-keys" });
  reset.addEventListener("click", () => {
    settings.set("bindings", {});
    draw();
  });
  draw();
  return el(
    "section",
    { class: "settings-keys" },
    el("h3", { text: t("settings.bindings") }),
    el("p", { class: "hint", text: t("settings.bindings.hint") }),
    note,
    rows,
    reset,
  );
}

function keyRow(action, note, draw) {
  const caps = bound(action).map((key) => el("kbd", { text: sign(key) }));
  const name = t(`action.${action}`);
  const button = el(
    "button",
    {
      type: "button",
      class: "key-change",
      testid: `key-${action}`,
      "aria-label": t("settings.change", { action: name }),
    },
    caps,
  );
  button.addEventListener("click", () => record(button, action, note, draw));
  return el("div", { class: "key-row" }, el("span", { text: name }), button);
}

/** The next key becomes the action's; Escape leaves it as it was. */
function record(button, action, note, draw) {
  put(button, el("span", { class: "recording", text: t("settings.press") }));
  const finish = (text = "") => {
    button.removeEventListener("keydown", press);
    button.removeEventListener("blur", stop);
    note.textContent = text;
    draw();
    button.closest("dialog")?.querySelector(`[data-testid=key-${action}]`)?.focus();
  };
  const stop = () => finish();
  const press = (event) => {
    if (["Shift", "Control", "Alt", "Meta", "Tab"].includes(event.key)) return;
    event.preventDefault();
    if (event.key === "Escape") return finish();
    finish(bind(action, keyName(event)));
  };
  button.addEventListener("keydown", press);
  button.addEventListener("blur", stop);
}

/** Returns what to say about it. */
function bind(action, key) {
  const other = conflict(action, key);
  if (other) return t("settings.taken", { key: sign(key), action: t(`action.${other}`) });
  settings.set("bindings", { ...settings.get("bindings"), [action]: [key] });
  return t("settings.bound", { key: sign(key), action: t(`action.${action}`) });
}

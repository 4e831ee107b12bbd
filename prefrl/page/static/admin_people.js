/** Who labels: their numbers, and what an admin can do about each. */

import { Failed, post } from "./api.js";
import { el, isolate, openDialog, put, svg } from "./dom.js";
import { t } from "./strings.js";
import { toast } from "./toast.js";

const BAR = 64;

/** A number with its interval drawn beside it, or a dash with the reason. */
export function interval({ value, low, high, count, why }, { percent = true, middle = 0.5 } = {}) {
  if (value === null || value === undefined)
    return el(
      "span",
      { class: "undefined", title: why || t("people.none") },
      "–",
      el("span", { class: "sr-only", text: ` ${why}` }),
    );
  const shown = (number) => (percent ? `${Math.round(100 * number)}%` : number.toFixed(2));
  const range = low === null || low === undefined ? "" : t("people.range", { low: shown(low), high: shown(high) });
  return el(
    "span",
    { class: "interval", title: t("people.count", { count }) },
    el("b", { text: shown(value) }),
    range ? el("span", { class: "range", text: range }) : null,
    percent && range ? bar(value, low, high, middle) : null,
  );
}

function bar(value, low, high, middle) {
  const at = (number) => Math.min(1, Math.max(0, number)) * BAR;
  return svg(
    "svg",
    { class: "interval-bar", viewBox: `0 0 ${BAR} 8`, "aria-hidden": "true" },
    svg("line", { class: "track", x1: 0, x2: BAR, y1: 4, y2: 4 }),
    middle === null ? null : svg("line", { class: "middle", x1: at(middle), x2: at(middle), y1: 0, y2: 8 }),
    svg("line", { class: "spread", x1: at(low), x2: at(high), y1: 4, y2: 4 }),
    svg("circle", { cx: at(value), cy: 4, r: 3 }),
  );
}

const COLUMNS = [
  ["people.name", (row) => who(row)],
  ["people.answers", (row) => String(row.answers)],
  ["people.skips", (row) => String(row.skips)],
  [
    "people.median",
    (row) => (row.median_seconds === null ? "–" : t("people.seconds", { seconds: row.median_seconds.toFixed(1) })),
  ],
  ["people.hourly", (row) => (row.per_hour === null ? "–" : String(Math.round(row.per_hour)))],
  ["people.left", (row) => interval(row.left)],
  ["people.ties", (row) => interval(row.ties, { middle: null })],
  ["people.checks", (row) => interval(row.checks)],
  ["people.repeats", (row) => interval(row.repeats)],
  ["people.agreement", (row) => interval(row.agreement)],
  ["people.fast", (row) => String(row.too_fast)],
  [
    "people.seen",
    (row) =>
      row.last_seen ? new Date(row.last_seen).toLocaleString([], { dateStyle: "short", timeStyle: "short" }) : "–",
  ],
];

/** The table and the form for one more: an element with `draw(annotators)`. */
export function people(refresh) {
  const body = el("tbody", { testid: "annotators" });
  const head = el(
    "tr",
    {},
    COLUMNS.map(([key]) => el("th", { scope: "col", text: t(key) })),
    el("th", { scope: "col" }, el("span", { class: "sr-only", text: t("people.actions") })),
  );
  const root = el(
    "div",
    { class: "people" },
    el(
      "div",
      { class: "table-box", tabindex: "0", role: "region", "aria-label": t("admin.people") },
      el("table", {}, el("thead", {}, head), body),
    ),
    invite(refresh),
  );
  root.draw = (annotators) =>
    put(body, ...(annotators.length ? annotators.map((row) => line(row, refresh)) : [nobody()]));
  return root;
}

function nobody() {
  return el("tr", {}, el("td", { class: "empty", colspan: String(COLUMNS.length + 1), text: t("people.nobody") }));
}

function who({ name, role, state, concerns }) {
  const states = { active: t("people.active"), paused: t("people.paused"), revoked: t("people.revoked") };
  return el(
    "span",
    { class: "who" },
    el("b", {}, isolate(name)),
    el("span", { class: "role", text: role }),
    el("span", { class: `state ${state}`, text: states[state] }),
    concerns.map((text) => el("span", { class: "concern", testid: "concern", text })),
  );
}

function line(row, refresh) {
  const act = (verb, key, dangerous = false) => {
    const button = el("button", {
      type: "button",
      class: "small",
      testid: `${verb}-${row.name}`,
      text: t(key),
      "aria-label": t("people.act", { action: t(key), name: row.name }),
    });
    button.addEventListener("click", () => (!dangerous || sure(button)) && perform(row.name, verb, refresh));
    return button;
  };
  const turn = row.state === "active" ? () => act("pause", "people.pause") : () => act("resume", "people.resume");
  // Who was revoked stays so: the server takes nothing back of that.
  const buttons =
    row.state === "revoked" ? [] : [turn(), act("invite", "people.invite"), act("revoke", "people.revoke", true)];
  return el(
    "tr",
    { class: row.state, testid: `annotator-${row.name}` },
    COLUMNS.map(([, cell], at) => el(at ? "td" : "th", at ? {} : { scope: "row" }, cell(row))),
    el("td", {}, el("div", { class: "row-actions" }, buttons)),
  );
}

/** True at the second press: the first one asks. */
function sure(button) {
  if (button.dataset.sure) return true;
  button.dataset.sure = "yes";
  button.textContent = t("people.sure");
  setTimeout(() => {
    delete button.dataset.sure;
    button.textContent = t("people.revoke");
  }, 4000);
  return false;
}

async function perform(name, verb, refresh) {
  try {
    const done = await post(`/api/admin/annotators/${encodeURIComponent(name)}/${verb}`);
    if (done?.link) linkDialog(name, done.link);
    await refresh();
  } catch (error) {
    if (!(error instanceof Failed)) throw error;
    toast(error.message, { kind: "bad", sign: "warning" });
  }
}

/** Invite somebody: a name, a role, and a link that is shown this once. */
function invite(refresh) {
  const name = el("input", {
    type: "text",
    required: true,
    maxlength: "80",
    autocomplete: "off",
    testid: "invite-name",
    placeholder: t("people.new"),
    "aria-label": t("people.new"),
  });
  const role = el(
    "select",
    { "aria-label": t("people.role"), testid: "invite-role" },
    ["annotator", "admin", "trainer"].map((value) => el("option", { value, text: value })),
  );
  const form = el(
    "form",
    { class: "inline-form" },
    name,
    role,
    el("button", { type: "submit", class: "primary", testid: "invite", text: t("people.add") }),
  );
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    try {
      const { link } = await post("/api/admin/annotators", { name: name.value.trim(), role: role.value });
      linkDialog(name.value.trim(), link);
      name.value = "";
      await refresh();
    } catch (error) {
      if (!(error instanceof Failed)) throw error;
      toast(error.message, { kind: "bad", sign: "warning" });
    }
  });
  return form;
}

/** The link in a field that can be marked: the clipboard is closed to pages without TLS. */
function linkDialog(name, link) {
  const field = el("input", {
    type: "text",
    readonly: true,
    class: "link-field",
    testid: "invite-link",
    "aria-label": t("link.field"),
  });
  field.value = link;
  field.addEventListener("focus", () => field.select());
  const secret = link.startsWith("http") ? t("link.hint") : t("link.token");
  openDialog(t("link.title", { name }), [el("p", { text: secret }), field], { testid: "link-dialog" });
  field.focus();
}

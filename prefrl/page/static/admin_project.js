/** What an admin can change while people label, and take away. */

import { Failed, getFile, post } from "./api.js";
import { guidelineBody } from "./dialogs.js";
import { el, isolate, put } from "./dom.js";
import { t } from "./strings.js";
import { toast } from "./toast.js";

/** How many different people judge each question: an element with `draw(overlap)`. */
export function overlapForm(refresh) {
  const field = el("input", {
    type: "number",
    min: "1",
    max: "20",
    step: "1",
    required: true,
    testid: "overlap",
    "aria-label": t("admin.overlap"),
  });
  const form = el(
    "form",
    { class: "inline-form" },
    field,
    el("button", { type: "submit", class: "secondary", testid: "save-overlap", text: t("admin.save") }),
    el("p", { class: "hint", text: t("overlap.hint") }),
  );
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    send("/api/admin/project", { overlap: Number(field.value) }, refresh);
  });
  form.draw = (overlap) => {
    if (document.activeElement !== field) field.value = String(overlap);
  };
  return form;
}

/** The guideline's text beside how it will look. */
export function guidelineEditor({ version, text }, refresh) {
  const field = el("textarea", {
    rows: "14",
    maxlength: "20000",
    testid: "guideline-edit",
    "aria-label": t("admin.guideline"),
    placeholder: t("guideline.hint"),
  });
  field.value = text;
  const preview = el("div", { class: "preview", "aria-label": t("guideline.preview"), role: "region", tabindex: "0" });
  const draw = () => put(preview, guidelineBody({ version: "", text: field.value }));
  const save = el("button", { type: "button", class: "primary", testid: "save-guideline", text: t("guideline.save") });
  field.addEventListener("input", draw);
  save.addEventListener("click", () => send("/api/admin/guideline", { text: field.value }, refresh));
  draw();
  return el(
    "div",
    { class: "guideline-editor" },
    field,
    el("h3", { class: "overline", text: t("guideline.preview") }),
    preview,
    el(
      "div",
      { class: "inline-form" },
      save,
      el("p", { class: "hint", text: version ? t("guideline.note") : t("guideline.new") }),
    ),
  );
}

async function send(path, body, refresh) {
  try {
    await post(path, body);
    toast(t("admin.saved"), { kind: "good", sign: "check" });
    await refresh();
  } catch (error) {
    if (!(error instanceof Failed)) throw error;
    toast(error.message, { kind: "bad", sign: "warning" });
  }
}

/** Files to take away. */
export function exportsView(names) {
  if (!names.length) return el("p", { class: "empty", text: t("exports.none") });
  return el(
    "div",
    { class: "export-links" },
    names.map((name) => {
      const button = el("button", { type: "button", class: "secondary", testid: `export-${name}`, text: name });
      button.addEventListener("click", async () => {
        button.disabled = true;
        await take(name);
        button.disabled = false;
      });
      return button;
    }),
  );
}

/** Save an export, and say what it could not hold. */
async function take(name) {
  try {
    const { blob, about } = await getFile(`/api/admin/export/${encodeURIComponent(name)}`);
    const address = URL.createObjectURL(blob);
    el("a", { href: address, download: about.file }).click();
    setTimeout(() => URL.revokeObjectURL(address), 60_000);
    const left = Object.entries(about.left_out).map(([what, count]) => `${count} × ${what}`);
    const values = { name: about.file, written: about.written, left: left.join("; ") };
    const text = left.length ? t("exports.left", values) : t("exports.saved", values);
    toast([text, ...about.notes].join(" "), { sign: left.length ? "warning" : "check", seconds: left.length ? 30 : 8 });
  } catch (error) {
    if (!(error instanceof Failed)) throw error;
    toast(error.message, { kind: "bad", sign: "warning" });
  }
}

/** What people reported, newest first. */
export function flagsView(flags) {
  if (!flags.length) return el("p", { class: "empty", text: t("flags.none") });
  return el(
    "ul",
    { class: "flag-list", testid: "flags" },
    flags.map(({ at, actor, query, text }) =>
      el(
        "li",
        {},
        el("p", { dir: "auto", text }),
        el(
          "p",
          { class: "detail" },
          isolate(actor),
          " · ",
          new Date(at).toLocaleString([], { dateStyle: "short", timeStyle: "short" }),
          query ? [" · ", el("code", { text: query.slice(0, 12) })] : null,
        ),
      ),
    ),
  );
}

/** Small windows over the page: the keys, the guideline, a comment, a reported problem, what is unsent. */

import { get } from "./api.js";
import { el, openDialog, put } from "./dom.js";
import { newId } from "./ids.js";
import { bound, sign } from "./keys.js";
import { markdown } from "./markdown.js";
import { t } from "./strings.js";
import { toast } from "./toast.js";

/** Characters that the server takes. */
const LONGEST = 4000;

const GROUPS = {
  "help.answers": [
    "first",
    "second",
    "firstSlight",
    "secondSlight",
    "firstMuch",
    "secondMuch",
    "tie",
    "incomparable",
    "skip",
    "undo",
  ],
  "help.ranking": ["up", "down", "level", "submit"],
  "help.showing": ["stepBack", "stepOn", "more", "less", "most", "least", "own", "clear", "submit", "skip", "undo"],
  "help.writing": ["write", "skip", "undo"],
  "help.player": ["play", "replay", "back", "forward", "slower", "faster"],
  "help.page": ["written", "comment", "guideline", "help"],
};

/** Groups of keys that only some people need, by what these do. */
const ONLY = { judge: ["help.answers", "help.ranking"], action: ["help.showing"], rewrite: ["help.writing"] };

/** All keys of people who do this (`ask`), and what the answers mean. */
export function helpDialog(settingsOpened, ask) {
  const others = Object.keys(ONLY).filter((one) => one !== ask);
  const hidden = others.flatMap((one) => ONLY[one]);
  const groups = Object.entries(GROUPS)
    .filter(([title]) => !hidden.includes(title))
    .map(([title, actions]) =>
      el("section", { class: "key-group" }, el("h3", { text: t(title) }), el("dl", {}, actions.map(keyRow))),
    );
  const explained = ask === "judge" ? ["tie", "incomparable", "skip"] : ["skip"];
  const meaning = explained.map((name) =>
    el("p", {}, el("strong", { text: t(`meaning.${name}.title`) }), " ", t(`meaning.${name}`)),
  );
  const change = el("button", { type: "button", class: "secondary", text: t("help.change") });
  const dialog = openDialog(
    t("help.title"),
    [el("div", { class: "meanings" }, meaning), el("div", { class: "key-groups" }, groups)],
    {
      testid: "help-dialog",
      wide: true,
      actions: [change],
    },
  );
  change.addEventListener("click", () => {
    dialog.close();
    settingsOpened();
  });
}

function keyRow(action) {
  const keys = bound(action).map((key) => el("kbd", { text: sign(key) }));
  return [el("dt", {}, keys), el("dd", { text: t(`action.${action}`) })];
}

/** The guideline as it stands; `notice` where it changed since it was last read. Its version, once it is closed. */
export async function guidelineDialog({ notice = "" } = {}) {
  const { version, text } = await get("/api/guideline");
  const read = el("button", {
    type: "button",
    class: "primary",
    autofocus: true,
    testid: "guideline-read",
    text: t("guide.read"),
  });
  const body = [notice ? el("p", { class: "notice", text: notice }) : null, guidelineBody({ version, text })];
  const dialog = openDialog(t("guide.title"), body, { testid: "guideline-dialog", wide: true, actions: [read] });
  read.addEventListener("click", () => dialog.close());
  return new Promise((resolve) => dialog.addEventListener("close", () => resolve(version)));
}

/** The guideline's text, drawn as Markdown, and its version. */
export function guidelineBody({ version, text }) {
  const body = el(
    "div",
    { class: "prose rendered", dir: "auto" },
    text ? markdown(text) : el("p", { class: "empty", text: t("guide.none") }),
  );
  return el(
    "div",
    { class: "guideline", testid: "guideline-text" },
    body,
    version ? el("p", { class: "version" }, t("guide.version"), " ", el("code", { text: version })) : null,
  );
}

/** A remark that goes with the next answer: {comment, flags}. */
export function commentDialog(draft, done) {
  const field = el("textarea", {
    rows: "5",
    maxlength: String(LONGEST),
    testid: "comment-text",
    "aria-label": t("comment.title"),
    placeholder: t("comment.hint"),
  });
  field.value = draft.comment;
  const chosen = new Set(draft.flags);
  const flags = { unsure: t("comment.unsure"), "both good": t("comment.both-good"), "both bad": t("comment.both-bad") };
  const chips = Object.entries(flags).map(([flag, label]) => {
    const chip = el("button", {
      type: "button",
      class: "toggle",
      "aria-pressed": String(chosen.has(flag)),
      text: label,
    });
    chip.addEventListener("click", () => {
      chosen.has(flag) ? chosen.delete(flag) : chosen.add(flag);
      chip.setAttribute("aria-pressed", String(chosen.has(flag)));
    });
    return chip;
  });
  const keep = el("button", { type: "button", class: "primary", text: t("comment.keep"), testid: "comment-keep" });
  const dialog = openDialog(t("comment.title"), [el("div", { class: "chips" }, chips), field], {
    testid: "comment-dialog",
    actions: [keep],
  });
  const close = () => {
    done({ comment: written(field), flags: [...chosen] });
    dialog.close();
  };
  keep.addEventListener("click", close);
  field.addEventListener("keydown", (event) => event.key === "Enter" && (event.ctrlKey || event.metaKey) && close());
  field.focus();
}

/** What somebody wrote, less what the server takes in no text: NUL, and halves of characters. */
function written(field) {
  return field.value.replace(/[\0\p{Cs}]/gu, "").trim();
}

/** Something is wrong with this question, or with the page. */
export function reportDialog(outbox, assignment) {
  const field = el("textarea", {
    rows: "5",
    maxlength: String(LONGEST),
    testid: "report-text",
    "aria-label": t("report.title"),
    placeholder: t("report.hint"),
  });
  const send = el("button", { type: "button", class: "primary", text: t("report.send"), testid: "report-send" });
  const dialog = openDialog(t("report.title"), [field], { testid: "report-dialog", actions: [send] });
  send.addEventListener("click", () => {
    const text = written(field);
    if (!text) return field.focus();
    outbox.add("/api/flags", { submission_id: newId(), assignment_id: assignment, text });
    toast(t("report.thanks"), { kind: "good", sign: "flag" });
    return dialog.close();
  });
  field.focus();
}

/** What has not reached the server, and what it did not take. */
export function outboxDialog(outbox) {
  const body = el("div", { class: "outbox" });
  const draw = () =>
    put(
      body,
      el("p", { text: t(`save.${outbox.state}.long`, { count: outbox.unsent.length }) }),
      ...outbox.refused.map((item) => refusedRow(item, outbox)),
    );
  const retry = el("button", {
    type: "button",
    class: "secondary",
    text: t("save.retry"),
    on: { click: () => outbox.hurry() },
  });
  outbox.addEventListener("change", draw);
  const dialog = openDialog(t("save.title"), [body], { testid: "outbox-dialog", actions: [retry] });
  dialog.addEventListener("close", () => outbox.removeEventListener("change", draw));
  draw();
}

function refusedRow(item, outbox) {
  return el(
    "div",
    { class: "refused" },
    el("p", { text: t("save.refused.item", { time: new Date(item.at).toLocaleTimeString(), reason: item.refused }) }),
    el("button", {
      type: "button",
      class: "link",
      text: t("save.dismiss"),
      on: { click: () => outbox.dismiss(item.id) },
    }),
  );
}

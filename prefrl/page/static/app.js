/** The page starts here: who is it, what is shown at this address, and what all views share. */

import { Failed } from "./api.js";
import { settingsDialog } from "./choices.js";
import { guidelineDialog, helpDialog } from "./dialogs.js";
import { put } from "./dom.js";
import { frame } from "./frame.js";
import { History } from "./history.js";
import { cap, listen } from "./keys.js";
import { Labelling } from "./label.js";
import { Outbox } from "./outbox.js";
import { Pace } from "./pace.js";
import { Session } from "./session.js";
import { dress, settings } from "./settings.js";
import { t } from "./strings.js";
import { toast } from "./toast.js";
import { Consent, Guide, welcome } from "./welcome.js";

const root = document.getElementById("app");
const session = new Session();
const outbox = new Outbox();
const pace = new Pace();

const app = { session, outbox, pace, go, guideline, help, settings: () => settingsDialog(() => session.leave()) };

let page = null;
let view = null;

/** True where nothing is shown before a person has agreed. */
const gated = (path) => path !== "/guide" && path !== "/admin";

/** The view of an address; the administration is fetched only by those who may see it. */
async function make(path, extra) {
  if (session.state.consent && gated(path)) return new Consent(app);
  if (path === "/history") return new History(app);
  if (path === "/guide") return new Guide();
  if (path === "/admin" && session.me.role === "admin") return new (await import("./admin.js")).Admin(app);
  return new Labelling(app, extra);
}

/** Go to an address of this page; `extra` is handed to its view. */
function go(path, extra = null) {
  history.pushState(null, "", path);
  return show(extra);
}

async function show(extra = null) {
  if (!page) return;
  const path = location.pathname === "/" ? "/label" : location.pathname;
  if (path !== location.pathname) history.replaceState(null, "", path);
  const next = await make(path, extra);
  view?.unmount();
  view = next;
  page.here(path);
  await view.mount(page.view);
  cap();
  document.title = t("page.title", { title: session.me.page.title });
}

function help() {
  helpDialog(app.settings, session.me.page.ask);
}

/** Show the guideline; once it is closed, this version counts as read. */
async function guideline(notice = "") {
  try {
    settings.set("guideline", await guidelineDialog({ notice }));
  } catch (error) {
    if (!(error instanceof Failed)) throw error;
    toast(error.message, { kind: "bad", sign: "warning" });
  }
}

/** What must be agreed to comes before all else, also while somebody is at work. */
async function offerConsent() {
  const owed = Boolean(session.state.consent);
  if (!page || !view || owed === view instanceof Consent || !gated(location.pathname)) return;
  await show();
  offerGuideline();
}

/** A guideline that is new to this browser is put before the person, once, and after what must be agreed to. */
let offered = "";
function offerGuideline() {
  const { guideline: version, consent: owed } = session.state;
  const read = settings.get("guideline");
  const busy = !view || owed || location.pathname === "/admin" || document.querySelector("dialog[open]");
  if (!version || version === read || version === offered || busy) return;
  offered = version;
  guideline(read ? t("guide.changed") : t("guide.first"));
}

async function start() {
  try {
    await session.open();
  } catch (error) {
    if (!(error instanceof Failed)) throw error;
    welcome(root, error, start);
    return;
  }
  page = frame(app);
  put(root, page.element);
  await outbox.start(session.me.name, session.me.store);
  await show();
  offerGuideline();
}

function signedOut() {
  if (!page) return;
  view?.unmount();
  view = page = null;
  session.me = null;
  document.querySelectorAll("dialog[open]").forEach((dialog) => dialog.close());
  welcome(root, new Failed(401, ""), start, outbox.unsent.length);
}

session.addEventListener("signedout", signedOut);
session.addEventListener("state", offerConsent);
session.addEventListener("state", offerGuideline);
session.addEventListener("online", () => outbox.hurry());
outbox.addEventListener("signedout", signedOut);
// An answer sent twice by us is a duplicate too, and nothing to speak of.
outbox.addEventListener(
  "receipt",
  ({ detail }) => detail.receipt?.duplicate && detail.item.tries === 1 && toast(t("save.duplicate")),
);
outbox.addEventListener("refused", ({ detail }) =>
  toast(t("save.refused.now", { reason: detail.error.message }), { kind: "bad", sign: "warning", seconds: 10 }),
);
addEventListener("online", () => (outbox.hurry(), page && session.poll()));
addEventListener("offline", () => page && session.poll());
addEventListener("popstate", () => show());
// A link opened in a tab that has the page already changes the fragment only.
addEventListener("hashchange", () => location.hash.length > 20 && location.reload());
addEventListener("beforeunload", (event) => outbox.unsent.length && event.preventDefault());
document.addEventListener("visibilitychange", () => document.hidden || (page && session.poll()));
document.addEventListener("click", (event) => {
  const link = event.target instanceof Element ? event.target.closest("a[data-path]") : null;
  if (!link || event.ctrlKey || event.metaKey || event.shiftKey) return;
  event.preventDefault();
  go(link.dataset.path);
});
// After a click, keys are for the question again, not for the button that was clicked.
document.addEventListener("click", (event) => {
  const button = event.target instanceof Element ? event.target.closest(".label button, .top button") : null;
  if (button && event.detail > 0) button.blur();
});

dress();
listen({ help, guideline: () => guideline() });
start();

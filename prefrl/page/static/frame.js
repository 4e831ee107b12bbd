/** The bar at the top: what this is, where one can go, how far it is, and whether everything is saved. */

import { el, icon, iconButton, put } from "./dom.js";
import { outboxDialog } from "./dialogs.js";
import { t } from "./strings.js";

const SIGNS = { saved: "check", saving: "spinner", offline: "cloudOff", refused: "warning", idle: "check" };

/** The page's frame: {element, view, here(path)}; views are put into `view`. */
export function frame(app) {
  const links = [
    ["/label", "nav.label"],
    ["/history", "nav.history"],
    ["/guide", "nav.guide"],
  ];
  if (app.session.me.role === "admin") links.push(["/admin", "nav.admin"]);
  const nav = el(
    "nav",
    { class: "nav", "aria-label": t("nav.name") },
    links.map(([path, key]) => el("a", { href: path, data: { path }, text: t(key) })),
  );
  const banner = el("div", { class: "banner", role: "alert", testid: "banner", hidden: true });
  const element = el(
    "header",
    { class: "top" },
    el("a", { class: "skip-link", href: "#main", text: t("nav.skip") }),
    el(
      "div",
      { class: "brand" },
      el("span", { class: "brand-mark", "aria-hidden": "true" }),
      el("span", { class: "brand-title", text: app.session.me.page.title }),
    ),
    nav,
    progress(app.session),
    saveState(app.outbox),
    el(
      "div",
      { class: "top-tools" },
      iconButton("book", t("nav.guideline"), {
        action: "guideline",
        testid: "guideline",
        on: { click: () => app.guideline() },
      }),
      iconButton("help", t("nav.help"), { action: "help", testid: "help", on: { click: () => app.help() } }),
      iconButton("gear", t("nav.settings"), { testid: "settings", on: { click: () => app.settings() } }),
    ),
  );
  watchBanner(app, banner);
  const view = el("div", { class: "view" });
  const here = (path) =>
    nav.querySelectorAll("a").forEach((link) => {
      if (link.dataset.path === path) link.setAttribute("aria-current", "page");
      else link.removeAttribute("aria-current");
    });
  return { element: el("div", { class: "frame" }, element, banner, view), view, here };
}

/** How many are mine, and how far all of them are. */
function progress(session) {
  const bar = el("progress", { class: "progress-bar", max: "1", value: "0", "aria-label": t("progress.name") });
  const words = el("span", { class: "progress-words" });
  const draw = () => {
    const { mine, answered, asked } = session.state.progress;
    bar.max = Math.max(1, asked);
    bar.value = answered;
    put(
      words,
      el("b", { text: String(mine) }),
      ` ${t("progress.mine")}`,
      el("span", { class: "progress-all", text: t("progress.all", { answered, asked }) }),
    );
  };
  session.addEventListener("state", draw);
  draw();
  return el("div", { class: "progress", testid: "progress" }, words, bar);
}

function saveState(outbox) {
  const words = el("span", { class: "save-words" });
  const sign = el("span", { class: "save-sign" });
  const button = el("button", { type: "button", class: "save-state", testid: "save-state" }, sign, words);
  button.addEventListener("click", () => outboxDialog(outbox));
  const draw = () => {
    const { state, unsent, refused } = outbox;
    if (button.dataset.state !== state) put(sign, icon(SIGNS[state]));
    button.dataset.state = state;
    button.dataset.unsent = String(unsent.length);
    words.textContent = t(`save.${state}`, { count: state === "refused" ? refused.length : unsent.length });
  };
  outbox.addEventListener("change", draw);
  draw();
  return button;
}

/** One line over the page for what everybody must know now. */
function watchBanner({ session, outbox }, banner) {
  const draw = () => {
    const text = session.state.read_only
      ? t("banner.read-only")
      : !session.online
        ? t("banner.offline")
        : session.state.paused
          ? t("banner.paused")
          : "";
    banner.hidden = !text;
    if (banner.textContent !== text) put(banner, text && icon("warning"), text);
  };
  for (const name of ["state", "online", "offline"]) session.addEventListener(name, draw);
  outbox.addEventListener("change", draw);
  draw();
}

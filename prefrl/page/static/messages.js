/** Pages that say why there is nothing to judge just now. */

import { el, icon } from "./dom.js";
import { t } from "./strings.js";

const SIGNS = {
  waiting: "cup",
  done: "check",
  paused: "pause",
  "read-only": "warning",
  offline: "cloudOff",
  trouble: "warning",
  consent: "spinner",
  sending: "spinner",
  loading: "spinner",
};

const TEXTS = () => ({
  waiting: [t("wait.waiting.title"), t("wait.waiting")],
  done: [t("wait.done.title"), t("wait.done")],
  paused: [t("wait.paused.title"), t("wait.paused")],
  "read-only": [t("wait.read-only.title"), t("wait.read-only")],
  offline: [t("wait.offline.title"), t("wait.offline")],
  trouble: [t("wait.trouble.title"), t("wait.trouble")],
  consent: [t("wait.loading.title"), ""],
  sending: [t("wait.sending.title"), t("wait.sending")],
  loading: [t("wait.loading.title"), ""],
});

/** A card for a situation {now, detail, count}. */
export function message({ now, detail, count }) {
  const [title, text] = TEXTS()[now];
  return card(
    SIGNS[now],
    title,
    [
      text ? el("p", { text }) : null,
      now === "trouble" && detail ? el("p", { class: "detail", text: detail }) : null,
      count ? el("p", { class: "detail", text: t(count === 1 ? "pace.one" : "pace.count", { count }) }) : null,
    ],
    now,
  );
}

/** A sign, a title, and what there is to say. */
export function card(sign, title, content, now = "") {
  return el(
    "section",
    { class: "card-page", testid: "message", data: { situation: now }, role: "status" },
    el("div", { class: `card-sign ${sign}` }, icon(sign)),
    el("h1", { text: title }),
    content,
  );
}

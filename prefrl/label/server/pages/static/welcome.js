/** Pages before one is signed in, and the guideline's own page. */

import { Failed, get } from "./api.js";
import { guidelineBody } from "./dialogs.js";
import { el, put } from "./dom.js";
import { card } from "./messages.js";
import { t } from "./strings.js";

/** Who has no link, or one that is no longer good, reads here what to do. */
export function welcome(root, error, retry, unsent = 0) {
  const refused = error.status === 401 || error.status === 403;
  const again = el("button", { type: "button", class: "primary", text: t("welcome.retry"), on: { click: retry } });
  const content = [
    el("p", { text: refused ? t("welcome.link") : t("welcome.unreachable") }),
    refused ? el("p", { class: "detail", text: t("welcome.how") }) : el("p", { class: "detail", text: error.message }),
    unsent
      ? el("p", { class: "notice", text: t(unsent === 1 ? "welcome.unsent.one" : "welcome.unsent", { count: unsent }) })
      : null,
    refused ? null : again,
  ];
  const sign = refused ? "book" : "cloudOff";
  put(
    root,
    el(
      "main",
      { class: "welcome", id: "main", testid: "welcome" },
      card(sign, refused ? t("welcome.title") : t("welcome.unreachable.title"), content),
    ),
  );
}

/** The guideline as a page. */
export class Guide {
  #root = el("main", { class: "page guide", id: "main" });

  async mount(root) {
    put(root, this.#root);
    try {
      put(this.#root, el("h1", { text: t("guide.title") }), guidelineBody(await get("/api/guideline")));
    } catch (error) {
      if (!(error instanceof Failed)) throw error;
      put(this.#root, card("warning", t("guide.trouble"), [el("p", { text: error.message })]));
    }
  }

  unmount() {}
}

/** Pages before one is signed in, and the guideline's own page. */

import { Failed, get, post } from "./api.js";
import { guidelineBody } from "./dialogs.js";
import { el, put } from "./dom.js";
import { card } from "./messages.js";
import { t } from "./strings.js";
import { toast } from "./toast.js";

/** Who has no link, or one that is no longer good, reads here what to do; and who cannot come in just now. */
export function welcome(root, error, retry, unsent = 0) {
  const { refused, sign, title, text } = reason(error.status);
  const again = el("button", { type: "button", class: "primary", testid: "retry", text: t("welcome.retry") });
  again.addEventListener("click", retry);
  const content = [
    el("p", { text }),
    el("p", { class: "detail", text: refused ? t("welcome.how") : error.message }),
    unsent
      ? el("p", { class: "notice", text: t(unsent === 1 ? "welcome.unsent.one" : "welcome.unsent", { count: unsent }) })
      : null,
    refused ? null : again,
  ];
  put(root, el("main", { class: "welcome", id: "main", testid: "welcome" }, card(sign, title, content)));
}

function reason(status) {
  if (status === 401 || status === 403)
    return { refused: true, sign: "book", title: t("welcome.title"), text: t("welcome.link") };
  if (status === 429) return { sign: "pause", title: t("welcome.busy.title"), text: t("welcome.busy") };
  return { sign: "cloudOff", title: t("welcome.unreachable.title"), text: t("welcome.unreachable") };
}

/** The guideline as a page. */
export class Guide {
  #root = el("main", { class: "page guide", id: "main" });

  async mount(root) {
    put(root, this.#root);
    await draw(this.#root, "/api/guideline", (guideline) => [
      el("h1", { text: t("guide.title") }),
      guidelineBody(guideline),
    ]);
  }

  unmount() {}
}

/** What a person must agree to before the first question. */
export class Consent {
  #session;
  #root = el("main", { class: "page guide", id: "main", testid: "consent" });

  constructor({ session }) {
    this.#session = session;
  }

  async mount(root) {
    put(root, this.#root);
    await draw(this.#root, "/api/consent", (consent) => [
      el("h1", { text: t("guide.first") }),
      guidelineBody(consent),
      el("button", {
        type: "button",
        class: "primary",
        testid: "agree",
        text: t("consent.agree"),
        on: { click: () => this.#agree(consent) },
      }),
    ]);
  }

  unmount() {}

  /** The state that the server tells next says that nothing is owed any more. */
  async #agree({ version }) {
    try {
      await post("/api/consent", { version });
    } catch (error) {
      if (!(error instanceof Failed)) throw error;
      toast(error.message, { kind: "bad", sign: "warning" });
    }
    await this.#session.poll();
  }
}

/** Put what is at an address on a page, or why it is not there. */
async function draw(root, path, parts) {
  try {
    put(root, parts(await get(path)));
  } catch (error) {
    if (!(error instanceof Failed)) throw error;
    put(root, card("warning", t("guide.trouble"), [el("p", { text: error.message })]));
  }
}

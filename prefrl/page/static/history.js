/** The last answers of a person: to look at again, and to change. */

import { Failed, get, post } from "./api.js";
import { el, put } from "./dom.js";
import { newId } from "./ids.js";
import { card } from "./messages.js";
import { Player } from "./player.js";
import { t } from "./strings.js";
import { LongText } from "./longtext.js";
import { snippet } from "./textview.js";
import { toast } from "./toast.js";
import { transport } from "./transport.js";
import { inWords } from "./verdict.js";

export class History {
  #app;
  #root = el("main", { class: "page history", id: "main" });
  #players = new Map();

  constructor(app) {
    this.#app = app;
  }

  async mount(root) {
    put(root, this.#root);
    put(this.#root, card("spinner", t("wait.loading.title"), [], "loading"));
    try {
      const { entries } = await get("/api/history");
      this.#draw(entries);
    } catch (error) {
      if (!(error instanceof Failed)) throw error;
      put(this.#root, card("warning", t("history.trouble"), [el("p", { text: error.message })], "trouble"));
    }
  }

  unmount() {
    this.#players.forEach((player) => player.close());
  }

  #draw(entries) {
    if (!entries.length) {
      put(this.#root, card("cup", t("history.none.title"), [el("p", { text: t("history.none") })], "none"));
      return;
    }
    put(
      this.#root,
      el("h1", { text: t("history.title") }),
      el("p", { class: "lead", text: t("history.lead", { count: entries.length }) }),
      el(
        "ol",
        { class: "entries", testid: "entries" },
        entries.map((entry) => this.#row(entry)),
      ),
    );
  }

  #row(entry) {
    const { assignment, answer, at } = entry;
    const change = el("button", {
      type: "button",
      class: "secondary",
      testid: "change",
      text: t("history.change"),
      on: { click: () => this.#change(assignment) },
    });
    const content = el("div", { class: "entry-content" });
    const details = el("details", {}, el("summary", { text: t("history.look") }), content);
    details.addEventListener("toggle", () => this.#look(details, content, assignment));
    return el(
      "li",
      { class: "entry", testid: "entry" },
      el("time", { datetime: at, text: new Date(at).toLocaleString([], { dateStyle: "medium", timeStyle: "short" }) }),
      el(
        "div",
        { class: "entry-main" },
        el("span", { class: `answer-chip ${answer.outcome}`, text: inWords(answer, this.#app.session.me.page.ask) }),
        assignment.prompt ? el("p", { class: "entry-prompt" }, snippet(assignment.prompt, 140)) : null,
        answer.shown?.text ? el("p", { class: "entry-shown" }, snippet(answer.shown.text, 200)) : null,
        answer.comment ? el("p", { class: "entry-comment" }, "“", el("bdi", { text: answer.comment }), "”") : null,
        details,
      ),
      change,
    );
  }

  #look(details, content, assignment) {
    this.#players.get(details)?.close();
    this.#players.delete(details);
    put(content);
    if (!details.open) return;
    const film = assignment.items.some((item) => item.media.length);
    const player = film ? new Player(assignment.items) : null;
    if (player) this.#players.set(details, player);
    const slots = assignment.items.map((item, at) =>
      el(
        "div",
        { class: "entry-slot" },
        el("span", { class: "badge", data: { slot: String(at) }, text: String(at + 1) }),
        player ? player.clips[at].element : plain(item.text),
      ),
    );
    put(content, el("div", { class: "entry-slots" }, slots), player && transport(player).element);
    player?.begin();
  }

  async #change(assignment) {
    try {
      const taken = await post("/api/undo", { submission_id: newId(), assignment_id: assignment.assignment_id });
      this.#app.go("/label", taken);
    } catch (error) {
      if (!(error instanceof Failed)) throw error;
      toast(error.message, { kind: "bad", sign: "warning" });
    }
  }
}

function plain(text) {
  const view = new LongText(text ?? "");
  view.show({});
  return view.element;
}

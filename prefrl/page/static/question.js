/** One question on the page: what is asked, the candidates, and the ways to answer. */

import { Acting } from "./acting.js";
import { calm, el, icon, iconButton } from "./dom.js";
import { drafts } from "./drafts.js";
import { cap, listen } from "./keys.js";
import { Player } from "./player.js";
import { Ranking } from "./ranking.js";
import { Rewriting } from "./rewriting.js";
import { Stopwatch } from "./stopwatch.js";
import { promptView, Responses } from "./textview.js";
import { t } from "./strings.js";
import { transport } from "./transport.js";
import { means, verdict } from "./verdict.js";

/** No one judges faster than this, but a key or a double click may still be meant for the question before. */
const GUARD = 300;

export class Question {
  #page;
  #assignment;
  #answer;
  #earlier;
  #locked = true;
  #given = false;
  #watch = new Stopwatch();
  #stops = [];
  #player = null;
  #prompt = null;
  #responses = null;
  /** What is filled in where two buttons do not do: {element, actions, disabled}. */
  #form = null;
  #choices = [];
  #note = el("p", { class: "gate", role: "status", testid: "gate", hidden: true });

  /** `answer(body, event)` gets what the server wants, less its ids; `tools` are buttons for the end of the bar. */
  constructor(assignment, { page, player, earlier, answer, tools }) {
    this.#assignment = assignment;
    this.#page = page;
    this.#answer = answer;
    this.#earlier = earlier ?? null;
    this.element = this.#build(player, tools);
    this.#open();
  }

  /** Take the keys away and stop the clips. */
  close() {
    this.#given = true;
    this.#stops.forEach((stop) => stop());
    this.#player?.close();
    this.#responses?.close();
    this.#form?.close?.();
    this.#watch.stop();
  }

  /** Show which answer was taken, while the next question comes. */
  confirm(outcome) {
    this.#given = true;
    this.element.dataset.chosen = outcome;
  }

  focus() {
    this.element.querySelector("h1").focus({ preventScroll: true });
  }

  get #pair() {
    return this.#assignment.items.length === 2;
  }

  #build(player, tools) {
    const { items, kind } = this.#assignment;
    const film = items.some((item) => item.media.length);
    if (film) this.#player = player ?? new Player(items);
    else this.#responses = new Responses(items, this.#page, this.#assignment.prompt);
    const prompt = promptView(this.#assignment.prompt, this.#page);
    if (prompt) this.#stops.push(prompt.close);
    this.#prompt = prompt;
    const bar = this.#bar(tools);
    this.#choices = bar.buttons;
    const still = film && items.every((item) => item.steps === 1);
    const controls = this.#player && !still && transport(this.#player);
    const form = this.#fill(items);
    this.#listen(bar.actions, controls?.actions, this.#responses?.actions);
    const beside = form instanceof Rewriting;
    const sort = form instanceof Ranking ? "many" : form ? "showing" : "pair";
    const element = el(
      "article",
      {
        class: `question ${film ? "film" : "text"} ${sort}${still ? " still" : ""}`,
        testid: "question",
        data: { id: this.#assignment.assignment_id, kind, count: String(items.length), ready: "false" },
      },
      el(
        "div",
        { class: "asked-row" },
        el("h1", { class: "asked", tabindex: "-1", text: this.#page.question }),
        this.#responses && view(this.#responses.toolbar),
      ),
      prompt?.element,
      this.#responses?.toolbar,
      el(
        "div",
        { class: "stage" },
        el(
          "div",
          { class: "slots" },
          items.map((item, at) => this.#slot(item, at)),
          beside && form.element,
        ),
      ),
      controls?.element,
      beside ? null : form?.element,
      bar.element,
    );
    cap(element);
    return element;
  }

  #slot(item, at) {
    const body = this.#player ? this.#player.clips[at].element : this.#responses.elements[at];
    return el(
      "section",
      {
        class: "slot",
        testid: `slot-${at}`,
        data: { slot: String(at) },
        "aria-label": t("slot.name", { slot: at + 1 }),
      },
      el(
        "header",
        { class: "slot-head" },
        el("span", { class: "badge", data: { slot: String(at) }, text: this.#name(at) }),
        el("span", { class: "chosen-mark", "aria-hidden": "true" }, icon("check")),
      ),
      body,
    );
  }

  /** Candidates have numbers; a single one is what the policy did. */
  #name(at) {
    return this.#assignment.items.length > 1 ? String(at + 1) : t("slot.own");
  }

  #bar(tools) {
    return verdict({
      pair: this.#pair,
      ask: this.#page.ask,
      strength: this.#page.strength,
      earlier: this.#earlier,
      note: this.#note,
      tools,
      answer: (chosen, event) => this.#give(chosen, event),
    });
  }

  #fill(items) {
    if (this.#page.ask !== "judge") this.#form = this.#show(items[0]);
    else if (!this.#pair) this.#form = this.#rank(items);
    return this.#form;
  }

  /** People show one thing at a time: actions in a clip, or a text. What they have begun outlives a reload. */
  #show(item) {
    const id = this.#assignment.assignment_id;
    const common = {
      earlier: this.#earlier?.shown ?? drafts.get(id),
      keep: (shown) => drafts.set(id, shown),
      submit: (shown, event) => this.#give({ outcome: "shown", shown }, event),
    };
    if (this.#player) return new Acting(item, { ...common, player: this.#player, choices: this.#page.actions });
    return new Rewriting(item, { ...common, id, mark: (runs) => this.#responses.mark(runs, this.#page) });
  }

  #rank(items) {
    const submit = (order, event) =>
      this.#give({ outcome: "ranking", ranking: order.ranks, touched: order.touched }, event);
    const look = (slot) => {
      const found = this.element.querySelector(`.slot[data-slot="${slot}"]`);
      found.scrollIntoView({ block: "nearest", behavior: calm() ? "auto" : "smooth" });
    };
    return new Ranking(items, submit, this.#earlier?.ranking, { clips: this.#player?.clips, look });
  }

  #listen(...groups) {
    const form = this.#form;
    this.#stops.push(listen(Object.assign({}, ...groups, form?.actions), form?.digit));
  }

  /** Answers are taken when all is there to be seen, and a moment has passed. */
  async #open() {
    if (this.#player) {
      this.#player.addEventListener("time", () => this.#gate());
      this.#player.addEventListener("failed", () => this.#gate());
      this.#gate();
      await this.#player.ready;
      this.element.style.setProperty("--shape", String(Math.max(...this.#player.clips.map((clip) => clip.shape))));
    }
    await new Promise((resolve) => setTimeout(resolve, GUARD));
    this.#locked = false;
    this.#watch.ready();
    this.element.dataset.ready = "true";
    this.#gate();
  }

  /** Begin to play, once the question is on the page. */
  begin() {
    this.#prompt?.begin();
    this.#form?.begin?.();
    this.#player?.begin();
    this.#player?.ready.then(() => this.#gate());
  }

  /** Why an answer other than a skip cannot be given yet, or "". */
  get #closed() {
    if (!this.#player) return "";
    if (this.#player.failed) return t("gate.broken");
    const share = Math.min(1, ...this.#player.watched);
    if (share + 1e-9 >= this.#page.minimum_watched) return "";
    const percent = Math.round(100 * this.#page.minimum_watched);
    return t("gate.watch", { percent, done: Math.floor(100 * share) });
  }

  #gate() {
    const reason = this.#closed;
    const gate = this.#note;
    const player = this.#player;
    const idle = player && !player.still && !player.playing && !player.failed && player.time * player.fps < 1;
    const words = reason || (idle && this.element.dataset.ready === "true" ? t("gate.play") : "");
    if (gate.textContent !== words) gate.textContent = words;
    gate.hidden = !words;
    this.element.dataset.gate = this.#player?.failed ? "broken" : reason ? "watch" : "";
    if (this.#form) this.#form.disabled = Boolean(reason);
    for (const node of this.#choices) node.disabled = Boolean(reason) && node.dataset.action !== "skip";
    const verdictBar = this.element.querySelector(".verdict");
    verdictBar.setAttribute("aria-disabled", String(this.element.dataset.ready !== "true"));
  }

  /** A clip that never comes must not keep a person: a skip is taken at any time after the guard. */
  #give(chosen, event) {
    const skip = chosen.outcome === "skip";
    if (this.#given || (this.#locked && !(skip && this.#waited)) || (this.#closed && !skip)) return;
    this.#given = true;
    drafts.set(this.#assignment.assignment_id, null);
    const body = { ...chosen, timings: this.#timings(), input: means(event) };
    if (this.#page.strength === false || !["first", "second"].includes(chosen.outcome)) body.strength = null;
    this.#answer(body, event);
  }

  get #waited() {
    return this.#watch.read().visible_ms > GUARD;
  }

  #timings() {
    const player = this.#player;
    if (!player) return this.#watch.read();
    return { ...this.#watch.read(), replays: player.replays, speed: player.rate, watched: player.watched };
  }
}

/** On a small screen the ways to show texts wait behind a button. */
function view(toolbar) {
  const button = iconButton("eye", t("text.tools"), { testid: "view", "aria-expanded": "false" });
  button.classList.add("view-button");
  button.addEventListener("click", () => {
    const open = toolbar.classList.toggle("open");
    button.setAttribute("aria-expanded", String(open));
  });
  return button;
}

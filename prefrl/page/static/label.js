/** The labelling view: one question after another, what was answered kept and sent behind the scenes. */

import { Failed, get, post } from "./api.js";
import { Desk } from "./desk.js";
import { commentDialog, reportDialog } from "./dialogs.js";
import { calm, el, icon, iconButton, put } from "./dom.js";
import { newId } from "./ids.js";
import { cap, listen } from "./keys.js";
import { message } from "./messages.js";
import { Player } from "./player.js";
import { Question } from "./question.js";
import { settings } from "./settings.js";
import { t } from "./strings.js";
import { toast } from "./toast.js";
import { inWords } from "./verdict.js";

/** How long the chosen side lights up before the next question. */
const GLOW = 160;
/** Questions whose clips are loaded ahead. */
const AHEAD = 2;
/** How often to ask for questions while there are none. */
const ASK = 5000;

export class Labelling {
  #app;
  #desk;
  #root = el("main", { class: "label", id: "main" });
  #question = null;
  #shown = null;
  #earlier = new Map();
  #players = new Map();
  #given = [];
  #draft = { comment: "", flags: [] };
  #stops = [];
  #timers = [];
  #busy = false;
  #last = el("span", { class: "last", role: "status", testid: "last-answer" });
  #pace = el("span", { class: "pace", testid: "pace" });

  /** `app` is {session, outbox, pace, guideline(), help()}; `reopened` an answer taken back in the history. */
  constructor(app, reopened = null) {
    this.#app = app;
    this.#desk = new Desk(() => app.outbox.answering);
    if (reopened) this.#reopen(reopened);
  }

  mount(root) {
    put(root, this.#root);
    const { outbox, session } = this.#app;
    this.#on(this.#desk, "change", () => this.#show());
    this.#on(this.#desk, "elsewhere", () => toast(t("label.elsewhere")));
    this.#on(outbox, "receipt", () => this.#received());
    this.#on(outbox, "refused", ({ detail }) => this.#refused(detail.item));
    this.#on(outbox, "change", () => this.#desk.current || this.#show());
    this.#on(session, "state", () => this.#stateChanged());
    this.#on(document, "visibilitychange", () => document.hidden || this.#desk.refill());
    this.#stops.push(listen({ undo: () => this.undo(), comment: () => this.#comment() }));
    this.#timers.push(
      setInterval(() => this.#beat(), 1000),
      setInterval(() => this.#ask(), ASK),
    );
    this.#show();
    this.#desk.refill();
  }

  unmount() {
    this.#stops.forEach((stop) => stop());
    this.#timers.forEach(clearInterval);
    this.#question?.close();
    this.#players.forEach((player) => player.close());
  }

  /** Take back the last answer that still stands, in this sitting or before. */
  async undo() {
    if (this.#busy) return;
    this.#busy = true;
    try {
      await this.#takeBack();
    } catch (error) {
      if (!(error instanceof Failed)) throw error;
      toast(error.message, { kind: "bad", sign: "warning" });
    } finally {
      this.#busy = false;
    }
  }

  /** What this sitting knows is shown again at once; what is older has to be asked for. */
  async #takeBack() {
    const last = this.#given.at(-1);
    if (last) return this.#recall(last);
    const [entry] = (await get("/api/history")).entries;
    if (!entry) return void toast(t("undo.none"));
    return this.#undone(
      await post("/api/undo", { submission_id: newId(), assignment_id: entry.assignment.assignment_id }),
    );
  }

  /** An answer that never left is dropped; for any other, a retraction follows it. */
  async #recall({ assignment, body }) {
    const { outbox } = this.#app;
    const dropped = await outbox.withdraw(body.submission_id);
    if (!dropped) outbox.add("/api/undo", { submission_id: newId(), assignment_id: assignment.assignment_id });
    this.#undone({ assignment, answer: body });
  }

  #undone(taken) {
    this.#given = this.#given.filter((one) => one.assignment.assignment_id !== taken.assignment.assignment_id);
    this.#app.pace.undone();
    this.#say(t("undo.done", { answer: inWords(taken.answer, this.#app.session.me.page.ask) }), "undo");
    this.#reopen(taken);
  }

  #reopen({ assignment, answer }) {
    this.#earlier.set(assignment.assignment_id, answer);
    if (this.#shown?.assignment_id === assignment.assignment_id) this.#shown = null;
    this.#desk.reopen(assignment);
  }

  #on(target, name, handler) {
    target.addEventListener(name, handler);
    this.#stops.push(() => target.removeEventListener(name, handler));
  }

  /** Put on the page what is first in line, or why there is nothing. */
  #show() {
    const assignment = this.#desk.current;
    if (assignment && assignment === this.#shown) return this.#prefetch();
    this.#question?.close();
    this.#question = null;
    this.#shown = assignment;
    if (!assignment) return put(this.#root, message(this.#situation()));
    const id = assignment.assignment_id;
    const earlier = this.#earlier.get(id);
    this.#draft = { comment: earlier?.comment ?? "", flags: [...(earlier?.flags ?? [])] };
    this.#question = new Question(assignment, {
      page: this.#app.session.me.page,
      player: this.#players.get(id),
      earlier,
      answer: (body) => this.#answered(assignment, body),
      tools: this.#tools(),
    });
    this.#players.delete(id);
    put(this.#root, this.#question.element, this.#foot());
    cap(this.#root);
    this.#question.focus();
    this.#question.begin();
    return this.#prefetch();
  }

  /** Clips of the next questions load while this one is being looked at. */
  #prefetch() {
    const next = this.#desk.held.slice(1, 1 + AHEAD).filter((one) => one.items.some((item) => item.media.length));
    for (const [id, player] of this.#players) {
      if (next.some((one) => one.assignment_id === id)) continue;
      player.close();
      this.#players.delete(id);
    }
    for (const one of next)
      if (!this.#players.has(one.assignment_id)) this.#players.set(one.assignment_id, new Player(one.items));
  }

  #answered(assignment, given) {
    const { outbox, pace, session } = this.#app;
    const body = {
      submission_id: newId(),
      assignment_id: assignment.assignment_id,
      ...given,
      ...this.#draft,
      ui_version: session.me.page.ui_version,
      guideline: settings.get("guideline"),
    };
    outbox.add("/api/answers", body);
    this.#given = [...this.#given.slice(-59), { assignment, body }];
    this.#earlier.delete(assignment.assignment_id);
    pace.answered();
    this.#question.confirm(given.outcome);
    this.#say(t("label.last", { answer: inWords(body, session.me.page.ask) }), "check");
    // Taken back while it still glows, the question stays.
    const next = () => this.#given.some((one) => one.body === body) && this.#desk.finish(assignment.assignment_id);
    setTimeout(next, calm() ? 0 : GLOW);
    if (pace.tired(session.me.page.break_minutes))
      toast(t("label.break", { minutes: session.me.page.break_minutes }), { sign: "cup", seconds: 30 });
  }

  #received() {
    this.#desk.refill();
    this.#paces();
  }

  /** What somebody wrote and the server did not take comes back, to be changed. */
  #refused({ id, body }) {
    const given = body.shown && this.#given.find((one) => one.body === body);
    if (!given) return;
    this.#app.outbox.dismiss(id);
    this.#undone({ assignment: given.assignment, answer: body });
  }

  #stateChanged() {
    const { state } = this.#app.session;
    if (!this.#desk.current && (state.progress.waiting > 0 || state.finished || state.paused)) this.#desk.refill();
    this.#paces();
  }

  /** Why there is no question: what the server said last, or that it cannot be reached. */
  #situation() {
    const { error, reason } = this.#desk;
    const { outbox, pace } = this.#app;
    const waits = { offline: "offline", saving: "sending" }[outbox.state] ?? "loading";
    const now = error ? (error.status === 0 ? "offline" : "trouble") : (reason ?? waits);
    return { now, detail: error?.message ?? "", count: pace.count };
  }

  #ask() {
    if (!this.#desk.current && !document.hidden) this.#desk.refill();
  }

  /** Keep the leases of what is held, three times in their shortest life. */
  #beat() {
    if (document.hidden || !this.#desk.ids.length) return;
    const lease = Math.min(...this.#desk.held.map((one) => one.lease_seconds));
    if (performance.now() - (this.beaten ?? 0) < (lease * 1000) / 3) return;
    this.beaten = performance.now();
    post("/api/heartbeat", { assignments: this.#desk.ids.slice(0, 6) }).catch(() => undefined);
  }

  #tools() {
    const written = () => this.#draft.comment || this.#draft.flags.length;
    const comment = iconButton("comment", t("comment.open"), {
      action: "comment",
      testid: "comment",
      on: { click: () => this.#comment() },
    });
    comment.classList.toggle("on", Boolean(written()));
    this.commentButton = comment;
    return el(
      "div",
      { class: "others-tools" },
      comment,
      iconButton("flag", t("report.open"), {
        testid: "report",
        on: { click: () => reportDialog(this.#app.outbox, this.#shown?.assignment_id ?? null) },
      }),
      el(
        "button",
        {
          type: "button",
          class: "choice quiet undo",
          testid: "undo",
          data: { action: "undo" },
          on: { click: () => this.undo() },
        },
        icon("undo"),
        el("span", { class: "choice-label", text: t("undo.button") }),
        el("kbd"),
      ),
    );
  }

  #comment() {
    if (!this.#question) return;
    commentDialog(this.#draft, (draft) => {
      this.#draft = draft;
      this.commentButton.classList.toggle("on", Boolean(draft.comment || draft.flags.length));
    });
  }

  #say(text, sign) {
    put(this.#last, icon(sign), el("span", { text }));
  }

  #foot() {
    this.#paces();
    return el("footer", { class: "label-foot" }, this.#last, this.#pace);
  }

  #paces() {
    const { pace, session } = this.#app;
    const left = pace.left(session.state.progress.waiting);
    const parts = [
      pace.count ? t(pace.count === 1 ? "pace.one" : "pace.count", { count: pace.count }) : "",
      pace.hourly ? t("pace.rate", { rate: Math.round(pace.hourly) }) : "",
      left ? t(left < 1.5 ? "pace.minute" : "pace.left", { minutes: Math.round(left) }) : "",
    ];
    this.#pace.textContent = parts.filter(Boolean).join(" · ");
  }
}

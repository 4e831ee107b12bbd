/** What should be done at each step of one clip: the clip is gone through, and answers hold until the next one. */

import { el, icon, put } from "./dom.js";
import { Choices, dimensions, Sliders } from "./moves.js";
import { OWN, Plan } from "./plan.js";
import { t } from "./strings.js";
import { Track } from "./track.js";

/** The panel beside the clip: {element, actions, digit}. `submit(shown, event)` is called with an answer. */
export class Acting {
  step = 0;
  #plan;
  #player;
  #submit;
  #keep;
  #tracks;
  #moves;
  #title = el("h2", { id: "act-title", class: "act-step" });
  #state = el("span", { class: "act-state", testid: "act-state", role: "status" });
  #send = el(
    "button",
    { type: "button", class: "primary", testid: "submit-actions", data: { action: "submit" } },
    el("span", { class: "act-send" }),
    el("kbd"),
  );

  /** `choices` is what there is to do, `earlier` an earlier answer, and `keep(shown)` is called at each change. */
  constructor(item, { player, choices, submit, earlier = null, keep }) {
    this.#plan = new Plan(item.actions, earlier);
    this.#player = player;
    this.#submit = submit;
    this.#keep = keep;
    const ranges = dimensions(choices, item.actions);
    this.#moves = choices.discrete
      ? new Choices(choices.names, (row) => this.#set(row))
      : new Sliders(ranges, (row) => this.#set(row));
    const common = { steps: item.actions.length, seek: (step) => this.#go(step) };
    this.#tracks = choices.discrete
      ? [new Track({ ...common, choices: choices.names.length })]
      : ranges.map(({ low, high }) => new Track({ ...common, low, high }));
    this.element = this.#build();
    this.#send.addEventListener("click", (event) => this.submit(event));
    player.addEventListener("time", () => this.#follow());
    player.ready.then(() => this.#follow());
    this.#draw();
  }

  get actions() {
    const held = (run) => Object.assign(run, { held: true });
    return {
      stepBack: held(() => this.#go(this.step - 1)),
      stepOn: held(() => this.#go(this.step + 1)),
      more: held(() => this.#change(1)),
      less: held(() => this.#change(-1)),
      most: () => this.#change(Infinity),
      least: () => this.#change(-Infinity),
      own: () => this.#set(OWN),
      clear: () => this.#clear(),
      submit: (event) => this.submit(event),
    };
  }

  /** A number chooses a discrete action, or the dimension that the arrows change. */
  digit = (number) => {
    const row = this.#moves.pick(number);
    if (row) this.#set(row);
  };

  /** Send it; where a step has no answer yet, go there instead. */
  submit(event) {
    if (this.#plan.missing) return void this.#go(0);
    this.#submit({ actions: this.#plan.rows }, event);
  }

  set disabled(off) {
    this.#send.disabled = off;
  }

  #build() {
    const tool = (action, testid, run, label, sign) => {
      const content = [icon(sign), el("span", { class: "choice-label", text: label }), el("kbd")];
      const node = el("button", { type: "button", class: "choice quiet", testid, data: { action } }, content);
      node.addEventListener("click", run);
      return node;
    };
    const tracks = this.#tracks.map((track) => track.element);
    return el(
      "section",
      { class: "acting", "aria-labelledby": "act-title", testid: "acting" },
      el("header", { class: "act-head" }, this.#title, this.#state),
      el(
        "p",
        { class: "act-legend", "aria-hidden": "true" },
        el("span", { class: "swatch policy" }),
        t("act.policy"),
        el("span", { class: "swatch yours" }),
        t("act.you"),
      ),
      el(
        "p",
        { class: "act-keys", "aria-hidden": "true" },
        ["stepBack", "stepOn"].map(capped),
        el("span", { text: t("act.keys.step") }),
        ["more", "less"].map(capped),
        el("span", { text: t("act.keys.change") }),
      ),
      this.#moves.arranged(tracks),
      el(
        "div",
        { class: "act-tools" },
        tool("own", "act-own", () => this.#set(OWN), t("act.own"), "check"),
        tool("clear", "act-clear", () => this.#clear(), t("act.clear"), "close"),
      ),
      el("p", { class: "hint act-hint", text: t("act.hint") }),
      this.#send,
    );
  }

  #follow() {
    const step = Math.min(this.#plan.length - 1, this.#player.frame);
    if (step === this.step) return;
    this.step = step;
    this.#show();
  }

  #go(step) {
    this.step = Math.min(this.#plan.length - 1, Math.max(0, step));
    this.#player.show(this.step);
    this.#show();
  }

  #change(by) {
    this.#set(this.#moves.changed(this.#plan.row(this.step), by));
  }

  /** What is said while the clip plays is said of the picture that is there. */
  #set(row) {
    if (this.#player.playing) this.#go(this.step);
    this.#plan.set(this.step, row);
    this.#changed();
  }

  #clear() {
    this.#plan.clear(this.step);
    this.#changed();
  }

  #changed() {
    this.#keep(this.#plan.draft);
    this.#draw();
  }

  #draw() {
    this.#tracks.forEach((track, at) => track.draw(this.#plan, at));
    const { missing, length } = this.#plan;
    const words = this.#send.querySelector(".act-send");
    put(words, missing ? t(missing === length ? "act.none" : "act.missing", { last: missing }) : t("act.send"));
    this.#send.classList.toggle("unready", missing > 0);
    this.#show();
  }

  #show() {
    const { step } = this;
    const said = this.#plan.at(step);
    const from = this.#plan.source(step);
    const kind = said === undefined ? "open" : said === OWN ? "own" : "set";
    put(this.#title, t("act.step", { step: step + 1, steps: this.#plan.length }));
    this.#state.dataset.state = kind;
    put(this.#state, from === step ? t(`act.here.${kind}`) : t(`act.from.${kind}`, { step: from + 1 }));
    this.#tracks.forEach((track) => track.move(step));
    this.#moves.show(this.#plan.row(step), this.#plan.own(step), said !== undefined);
  }
}

/** The key of an action, in a line of words. */
function capped(action) {
  return el("span", { data: { action } }, el("kbd"));
}

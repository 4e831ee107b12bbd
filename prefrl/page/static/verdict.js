/** The buttons under a question: which one is better, and the other ways to answer. */

import { el, icon } from "./dom.js";
import { t } from "./strings.js";

const STEPS = ["slight", "clear", "much"];
const ACTIONS = {
  first: { slight: "firstSlight", clear: "first", much: "firstMuch" },
  second: { slight: "secondSlight", clear: "second", much: "secondMuch" },
};

/** A button with its key cap. */
function choice({ action, testid, label, short, spoken, kind, slot, sign, run }) {
  const node = el(
    "button",
    { type: "button", class: `choice ${kind}`, testid, "aria-label": spoken, data: { action } },
    slot === undefined ? null : el("span", { class: "badge", data: { slot: String(slot) }, text: String(slot + 1) }),
    sign ? icon(sign) : null,
    el("span", { class: "choice-label", text: label }),
    short ? el("span", { class: "choice-short", text: short }) : null,
    el("kbd"),
  );
  node.addEventListener("click", (event) => event.detail < 2 && run(event));
  return node;
}

/**
 * The bar for an assignment: {element, actions}. `answer({outcome, strength}, event)` is called with what was chosen,
 * `earlier` is an answer that was taken back, `note` says why there cannot be one yet, and `ask` what people do here.
 */
export function verdict({ pair, ask, strength, answer, earlier, note, tools }) {
  const buttons = [];
  const actions = {};
  const add = (outcome, step, look) => {
    const run = (event) => answer({ outcome, strength: step ?? null }, event);
    const node = choice({ ...look, run });
    actions[look.action] = run;
    if (earlier?.outcome === outcome && (!step || !strength || (earlier.strength ?? "clear") === step)) mark(node);
    buttons.push(node);
    return node;
  };
  const main = pair ? el("div", { class: strength ? "choices scale" : "choices" }, pairChoices(add, strength)) : null;
  const other = el(
    "div",
    { class: "others" },
    el(
      "div",
      { class: "others-answers" },
      add("incomparable", null, {
        action: "incomparable",
        testid: "incomparable",
        label: nothing(ask),
        kind: "quiet",
      }),
      add("skip", null, { action: "skip", testid: "skip", label: t("answer.skip"), kind: "quiet" }),
    ),
    note,
    tools,
  );
  const element = el(
    "div",
    { class: "verdict", role: "group", "aria-label": t("answer.group"), testid: "verdict" },
    main,
    other,
  );
  return { element, actions, buttons };
}

function mark(node) {
  node.classList.add("earlier");
  node.append(el("span", { class: "earlier-mark", text: t("answer.earlier") }));
}

function pairChoices(add, strength) {
  const tie = () =>
    add("tie", null, { action: "tie", testid: "tie", label: t("answer.tie"), kind: "tie", sign: "equal" });
  if (!strength) return [side(add, "first", 0), tie(), side(add, "second", 1)];
  const steps = (outcome, slot, order) =>
    el(
      "div",
      { class: `steps ${outcome}`, role: "group", "aria-label": t("answer.better", { slot: slot + 1 }) },
      el(
        "span",
        { class: "steps-title" },
        el("span", { class: "badge", data: { slot: String(slot) }, text: String(slot + 1) }),
        t("answer.is.better"),
      ),
      el(
        "div",
        { class: "steps-row" },
        order.map((step) => graded(add, outcome, slot, step)),
      ),
    );
  return [steps("first", 0, [...STEPS].reverse()), tie(), steps("second", 1, STEPS)];
}

function side(add, outcome, slot) {
  const look = {
    action: outcome,
    testid: `choose-${outcome}`,
    label: t("answer.is.better"),
    spoken: t("answer.better", { slot: slot + 1 }),
    kind: outcome,
    slot,
  };
  return add(outcome, "clear", look);
}

const LABELS = () => ({ slight: t("answer.slight"), clear: t("answer.clear"), much: t("answer.much") });
const SHORT = () => ({ slight: t("answer.slight.short"), clear: t("answer.clear.short"), much: t("answer.much") });
const SPOKEN = (slot) => ({
  slight: t("answer.slight.spoken", { slot }),
  clear: t("answer.clear.spoken", { slot }),
  much: t("answer.much.spoken", { slot }),
});

function graded(add, outcome, slot, step) {
  const testid = step === "clear" ? `choose-${outcome}` : `choose-${outcome}-${step}`;
  return add(outcome, step, {
    action: ACTIONS[outcome][step],
    testid,
    label: LABELS()[step],
    short: SHORT()[step],
    spoken: SPOKEN(slot + 1)[step],
    kind: `${outcome} ${step}`,
  });
}

/** What is said where there is nothing to answer. */
function nothing(ask) {
  if (ask === "action") return t("answer.untold");
  return ask === "rewrite" ? t("answer.fine") : t("answer.incomparable");
}

/** An answer in words; `ask` is what people do here. */
export function inWords({ outcome, strength, ranking, shown }, ask) {
  if (outcome === "shown") return shown?.text === undefined ? t("answer.shown") : t("answer.written");
  if (outcome === "first" || outcome === "second") {
    const slot = outcome === "first" ? 1 : 2;
    return strength ? SPOKEN(slot)[strength] : t("answer.better", { slot });
  }
  if (outcome === "ranking") return order(ranking ?? []);
  if (outcome === "tie") return t("answer.tie");
  return outcome === "skip" ? t("answer.skipped") : nothing(ask);
}

/** Ranks by slot as "2 > 1 = 3". */
function order(ranks) {
  const slots = ranks.map((_, slot) => slot).sort((a, b) => ranks[a] - ranks[b] || a - b);
  return slots
    .map((slot, at) => (at === 0 ? "" : ranks[slot] === ranks[slots[at - 1]] ? " = " : " > ") + (slot + 1))
    .join("");
}

/** How an event came about, as the server wants it. */
export function means(event) {
  if (!event || event.type.startsWith("key") || event.detail === 0) return "key";
  return event.pointerType === "touch" || event.pointerType === "pen" ? "touch" : "mouse";
}

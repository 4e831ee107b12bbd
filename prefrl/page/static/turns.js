/** Conversations: a transcript as the turns that it holds. */

import { el } from "./dom.js";
import { t } from "./strings.js";

/** What comes before a response, where its prompt is a transcript. */
export const CUE = "Assistant: ";

const TURN = /(?:^|\n\n)(System|Human|Assistant):(?: |$)/g;

/** The turns of a transcript, its last one perhaps empty, as `{speaker, content}`; null for other text. */
export function turns(text) {
  const whole = text.replace(/^\n+/, "");
  const found = [...whole.matchAll(TURN)];
  if (!found.length || found[0].index) return null;
  return found.map((turn, at) => ({
    speaker: turn[1],
    content: whole.slice(turn.index + turn[0].length, found[at + 1]?.index ?? whole.length),
  }));
}

/** Turns as nodes; `draw(content)` gives what one holds. The cue at the end of a prompt (`cued`) is no turn. */
export function bubbles(said, draw, cued) {
  return said
    .filter(({ speaker, content }, at) => content || !cued || speaker !== "Assistant" || at < said.length - 1)
    .map(({ speaker, content }) =>
      el(
        "div",
        { class: "turn", data: { speaker } },
        el("div", { class: "turn-speaker", text: t(`turn.${speaker}`) }),
        draw(content),
      ),
    );
}

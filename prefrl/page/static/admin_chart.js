/** Answers over time, as bars. */

import { el, svg } from "./dom.js";
import { t } from "./strings.js";

const WIDTH = 960;
const HEIGHT = 180;
const EDGE = { left: 34, right: 6, top: 14, bottom: 24 };
/** Room for a time under the bars. */
const LABEL = 90;
/** Bars at most; the newest stay. */
const BARS = 96;

/** `throughput` is [start, answers] oldest first; `unit` is "minute" or "hour". */
export function chart(throughput, unit) {
  const bars = throughput.slice(-BARS);
  if (!bars.length) return el("p", { class: "empty", text: t("chart.none") });
  const top = ceiling(Math.max(1, ...bars.map(([, count]) => count)));
  const name = t(unit === "minute" ? "chart.minute" : "chart.hour");
  return el(
    "figure",
    { class: "chart" },
    svg(
      "svg",
      { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "img", "aria-label": summary(name, bars) },
      grid(top),
      bars.map((bar, at) => column(bar, at, bars.length, top)),
      times(bars, unit),
    ),
    el("figcaption", { text: name }),
  );
}

function summary(name, bars) {
  const total = bars.reduce((sum, [, count]) => sum + count, 0);
  return t("chart.summary", { name, total, most: Math.max(...bars.map(([, count]) => count)) });
}

/** A round number at or above, which can be halved. */
function ceiling(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return [1, 2, 3, 4, 5, 6, 8, 10].map((factor) => factor * power).find((round) => round >= value);
}

const y = (count, top) => HEIGHT - EDGE.bottom - (count / top) * (HEIGHT - EDGE.top - EDGE.bottom);

function grid(top) {
  const lines = top % 2 === 0 ? [0, top / 2, top] : [0, top];
  return lines.map((count) =>
    svg(
      "g",
      { class: "grid" },
      svg("line", { x1: EDGE.left, x2: WIDTH - EDGE.right, y1: y(count, top), y2: y(count, top) }),
      svg("text", { x: EDGE.left - 6, y: y(count, top) + 4, "text-anchor": "end", text: String(count) }),
    ),
  );
}

function slot(at, count) {
  const width = (WIDTH - EDGE.left - EDGE.right) / Math.max(count, 24);
  return { x: EDGE.left + at * width, width };
}

function column([start, count], at, bars, top) {
  const { x, width } = slot(at, bars);
  const height = HEIGHT - EDGE.bottom - y(count, top);
  return svg(
    "rect",
    { class: "bar", x: x + width * 0.12, width: width * 0.76, y: y(count, top), height, rx: Math.min(3, width * 0.2) },
    svg("title", { text: `${clock(start)}: ${count}` }),
  );
}

function times(bars, unit) {
  const every = Math.ceil(LABEL / slot(0, bars.length).width);
  return bars.map(([start], at) => {
    if (at % every) return null;
    const { x, width } = slot(at, bars.length);
    return svg("text", {
      class: "time",
      x: x + width / 2,
      y: HEIGHT - 6,
      "text-anchor": "middle",
      text: clock(start, unit),
    });
  });
}

function clock(start) {
  return new Date(start).toLocaleTimeString([], { hour: "2-digit", minute: "2-digit" });
}

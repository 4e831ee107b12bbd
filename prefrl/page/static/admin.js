/** The administration: how much is answered, by whom, how well they agree, and what can be changed. */

import { Failed, get } from "./api.js";
import { chart } from "./admin_chart.js";
import { interval, people } from "./admin_people.js";
import { exportsView, flagsView, guidelineEditor, overlapForm } from "./admin_project.js";
import { el, put } from "./dom.js";
import { card } from "./messages.js";
import { t } from "./strings.js";

const OFTEN = 5000;

export class Admin {
  #root = el("main", { class: "page admin", id: "main", testid: "admin" });
  #timer = 0;
  #drawn = "";
  #sections = null;
  #gone = false;

  async mount(root) {
    put(root, this.#root);
    put(this.#root, card("spinner", t("wait.loading.title"), [], "loading"));
    await this.refresh();
  }

  unmount() {
    this.#gone = true;
    clearTimeout(this.#timer);
  }

  /** Fetch and draw; what did not change is left alone, so that nobody's focus or typing is lost. */
  refresh = async () => {
    clearTimeout(this.#timer);
    try {
      this.#draw(await get("/api/admin/overview"));
    } catch (error) {
      if (!(error instanceof Failed)) throw error;
      if (!this.#sections)
        put(this.#root, card("warning", t("admin.trouble"), [el("p", { text: error.message })], "trouble"));
    }
    if (!this.#gone) this.#timer = setTimeout(this.refresh, document.hidden ? 4 * OFTEN : OFTEN);
  };

  #draw(overview) {
    if (!this.#sections) this.#build(overview);
    const { health, ...rest } = overview;
    put(this.#sections.health, ...healthView(health));
    const now = JSON.stringify(rest);
    if (now === this.#drawn) return;
    this.#drawn = now;
    put(this.#sections.tiles, ...tiles(overview));
    put(this.#sections.chart, chart(overview.throughput, overview.throughput_unit));
    put(this.#sections.agreement, ...agreement(overview.agreement));
    put(this.#sections.flags, flagsView(overview.flags));
    put(this.#sections.exports, exportsView(overview.exports));
    keepFocus(this.#sections.people, () => this.#sections.people.draw(overview.annotators));
    this.#sections.overlap.draw(overview.overlap);
  }

  #build(overview) {
    const part = (className) => el("div", { class: className });
    this.#sections = {
      tiles: part("tiles"),
      chart: part("chart-box"),
      agreement: part("tiles plain"),
      flags: part("flags"),
      exports: part("exports"),
      health: part("health"),
      people: people(this.refresh),
      overlap: overlapForm(this.refresh),
      guideline: guidelineEditor(overview.guideline, this.refresh),
    };
    const s = this.#sections;
    put(
      this.#root,
      el("h1", { text: t("admin.title") }),
      s.tiles,
      panel("admin.throughput", s.chart),
      panel("admin.people", s.people),
      panel("admin.agreement", s.agreement),
      el(
        "div",
        { class: "columns" },
        el("div", {}, panel("admin.guideline", s.guideline)),
        el(
          "div",
          {},
          panel("admin.overlap", s.overlap),
          panel("admin.exports", s.exports),
          panel("admin.health", s.health),
          panel("admin.flags", s.flags),
        ),
      ),
    );
  }
}

function panel(title, content) {
  return el("section", { class: "panel" }, el("h2", { text: t(title) }), content);
}

function tile(label, value, note = "") {
  return el(
    "div",
    { class: "tile" },
    el("span", { class: "tile-value" }, value),
    el("span", { class: "tile-label", text: label }),
    note ? el("span", { class: "tile-note", text: note }) : null,
  );
}

function tiles({ asked, answered, open, leased, skipped, incomparable }) {
  const share = asked ? Math.round((100 * answered) / asked) : 0;
  return [
    tile(t("admin.answered"), `${answered} / ${asked}`, t("admin.percent", { share })),
    tile(t("admin.open"), String(open)),
    tile(t("admin.leased"), String(leased)),
    tile(t("admin.skipped"), String(skipped)),
    tile(t("admin.incomparable"), String(incomparable)),
  ];
}

function agreement(row) {
  const names = {
    raw: "agreement.raw",
    cohen: "agreement.cohen",
    fleiss: "agreement.fleiss",
    krippendorff: "agreement.krippendorff",
    intransitive: "agreement.intransitive",
  };
  const share = new Set(["raw", "intransitive"]);
  return Object.entries(names).map(([name, label]) =>
    tile(t(label), interval(row[name], { percent: share.has(name), middle: null })),
  );
}

function healthView({ store, sequence, queue, clips, uptime_seconds: uptime }) {
  const rows = [
    ["health.store", store === "ok" ? t("health.ok") : store],
    ["health.sequence", String(sequence)],
    ["health.queue", String(queue)],
    [
      "health.clips",
      Object.entries(clips)
        .map(([name, count]) => `${name} ${count}`)
        .join(" · ") || "–",
    ],
    [
      "health.uptime",
      t("health.hours", { hours: Math.floor(uptime / 3600), minutes: Math.floor((uptime % 3600) / 60) }),
    ],
  ];
  return [
    el(
      "dl",
      { class: `facts ${store === "ok" ? "good" : "bad"}` },
      rows.map(([label, value]) => [el("dt", { text: t(label) }), el("dd", { text: value })]),
    ),
  ];
}

/** Draw again, and put the focus back on the same control. */
function keepFocus(root, draw) {
  const id = root.contains(document.activeElement) ? document.activeElement.dataset.testid : null;
  draw();
  if (id) root.querySelector(`[data-testid="${CSS.escape(id)}"]`)?.focus();
}

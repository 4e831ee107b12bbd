/** The bar under the clips: play, frame by frame, where it is, and how fast. */

import { el, icon, iconButton, put } from "./dom.js";
import { SPEEDS } from "./player.js";
import { t } from "./strings.js";

/** The bar of a player, as {element, actions, close}. */
export function transport(player) {
  const play = iconButton("play", t("player.play"), {
    action: "play",
    testid: "play",
    on: { click: () => player.toggle() },
  });
  const scrub = el("input", {
    type: "range",
    class: "scrub",
    min: "0",
    max: "1",
    step: "any",
    value: "0",
    testid: "scrub",
    "aria-label": t("player.scrub"),
  });
  const clock = el("span", { class: "clock", testid: "clock", "aria-hidden": "true" });
  const speed = el(
    "select",
    { class: "speed", "aria-label": t("player.speed"), testid: "speed" },
    SPEEDS.map((one) => el("option", { value: String(one), text: t("player.times", { speed: one }) })),
  );
  speed.addEventListener("change", () => player.setRate(Number(speed.value)));
  scrub.addEventListener("input", () => player.seek(Number(scrub.value)));
  scrub.addEventListener("pointerup", () => scrub.blur());

  const showTime = () => {
    scrub.max = String(player.duration || 1);
    scrub.value = String(player.time);
    const last = Math.max(0, Math.round(player.duration * player.fps) - 1);
    const frame = Math.min(last, player.frame);
    clock.textContent = t("player.clock", {
      time: player.time.toFixed(1),
      duration: player.duration.toFixed(1),
      frame,
    });
    scrub.setAttribute("aria-valuetext", clock.textContent);
  };
  const showState = () => {
    put(play, icon(player.playing ? "pause" : "play"));
    const label = player.playing ? t("player.pause") : t("player.play");
    play.setAttribute("aria-label", label);
    play.title = label;
    speed.value = String(player.rate);
  };
  player.addEventListener("change", showState);
  player.addEventListener("time", showTime);
  player.ready.then(showTime);
  showState();
  showTime();

  const element = el(
    "div",
    { class: "transport", role: "group", "aria-label": t("player.name"), testid: "transport" },
    play,
    iconButton("replay", t("player.replay"), {
      action: "replay",
      testid: "replay",
      on: { click: () => player.replay() },
    }),
    iconButton("back", t("player.back"), { action: "back", on: { click: () => player.step(-1) } }),
    scrub,
    iconButton("forward", t("player.forward"), { action: "forward", on: { click: () => player.step(1) } }),
    clock,
    speed,
  );
  const actions = {
    play: () => player.toggle(),
    replay: () => player.replay(),
    back: () => player.step(-1),
    forward: () => player.step(1),
    slower: () => player.change(-1),
    faster: () => player.change(1),
  };
  return { element, actions };
}

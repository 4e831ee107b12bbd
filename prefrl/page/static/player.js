/** K clips in lock-step: one clock, one play button. Shorter clips hold their last frame until the longest ends. */

import { calm } from "./dom.js";
import { Clip } from "./clip.js";
import { settings } from "./settings.js";

export const SPEEDS = [0.25, 0.5, 1, 1.5, 2, 3, 4];
const HOLD = 900;
/** Frames apart from which a clip is set, not hastened. */
const FAR = 4;
/** By how much a clip is hastened or held back at most. */
const NUDGE = 0.1;

/** Events: `change` (playing, speed), `time` (where it is), `failed`. */
export class Player extends EventTarget {
  playing = false;
  replays = 0;
  #rate = settings.get("speed");
  #timer = 0;
  #loop = 0;
  #restarting = false;

  constructor(items) {
    super();
    this.clips = items.map((item) => new Clip(item));
    this.clips.forEach((clip) => {
      clip.addEventListener("failed", () => this.#failed());
      clip.addEventListener("seen", () => this.dispatchEvent(new Event("time")));
    });
    this.ready = Promise.all(this.clips.map((clip) => clip.ready)).then((shown) => shown.every(Boolean));
  }

  get failed() {
    return this.clips.some((clip) => clip.failed);
  }

  /** Seconds of the longest clip. */
  get duration() {
    return Math.max(0, ...this.#timed.map((clip) => clip.duration));
  }

  get time() {
    return this.#lead?.time ?? 0;
  }

  get fps() {
    return this.#lead?.fps ?? 30;
  }

  /** The frame that is shown, from 0 on; one beyond the last at the very end. */
  get frame() {
    return Math.floor(this.time * this.fps + 0.01);
  }

  get rate() {
    return this.#rate;
  }

  /** The share of each clip that was seen, slot by slot. */
  get watched() {
    return this.clips.map((clip) => clip.watched);
  }

  get still() {
    return this.#timed.length === 0;
  }

  async play() {
    if (this.playing || this.failed || this.still) return;
    this.playing = true;
    this.#changed();
    if (this.#lead.ended) await this.#rewind();
    await this.#go();
  }

  pause() {
    this.playing = false;
    clearTimeout(this.#timer);
    cancelAnimationFrame(this.#loop);
    this.clips.forEach((clip) => clip.pause());
    this.#changed();
  }

  toggle() {
    if (this.playing) this.pause();
    else this.play();
  }

  async replay() {
    this.replays += 1;
    this.pause();
    await this.#rewind();
    await this.play();
  }

  /** One frame on, or back. */
  step(frames) {
    this.show(this.frame + frames);
  }

  /** Go to a frame, and stay there. */
  show(frame) {
    return this.seek((frame + 0.25) / this.fps);
  }

  /** Go to a time, in seconds, and stay there. */
  async seek(time) {
    if (this.playing) this.pause();
    const goal = Math.min(Math.max(0, time), this.duration);
    await Promise.all(this.#timed.map((clip) => clip.seek(goal)));
    this.dispatchEvent(new Event("time"));
  }

  setRate(rate) {
    this.#rate = Math.min(SPEEDS.at(-1), Math.max(SPEEDS[0], rate));
    settings.set("speed", this.#rate);
    this.#timed.forEach((clip) => {
      clip.rate = this.#rate;
    });
    this.#changed();
  }

  /** One speed up (+1) or down (-1). */
  change(direction) {
    const now = SPEEDS.findIndex((speed) => speed >= this.#rate);
    this.setRate(SPEEDS[Math.min(SPEEDS.length - 1, Math.max(0, now + direction))]);
  }

  /** Start by itself, unless a person wants no motion. */
  async begin() {
    // It may have been fetched ahead, and the speed changed since.
    this.setRate(settings.get("speed"));
    if ((await this.ready) && settings.get("autoplay") && !calm()) await this.play();
  }

  close() {
    this.pause();
    this.clips.forEach((clip) => clip.close());
  }

  get #timed() {
    return this.clips.filter((clip) => !clip.loose && !clip.failed);
  }

  /** The longest clip keeps the time. */
  get #lead() {
    return this.#timed.reduce((best, clip) => (!best || clip.duration > best.duration ? clip : best), null);
  }

  async #rewind() {
    await Promise.all(this.#timed.map((clip) => clip.seek(0)));
  }

  async #go() {
    if (!this.playing) return;
    this.#timed.forEach((clip) => {
      clip.rate = this.#rate;
    });
    try {
      await Promise.all(this.#timed.map((clip) => clip.play()));
    } catch (error) {
      if (error.name === "NotAllowedError") this.pause();
    }
    cancelAnimationFrame(this.#loop);
    if (this.playing) this.#tick();
  }

  #tick() {
    if (!this.playing) return;
    if (this.#lead.ended) {
      this.#timer = setTimeout(() => this.#again(), HOLD);
      this.dispatchEvent(new Event("time"));
      return;
    }
    this.#align();
    this.#loop = requestAnimationFrame(() => this.#tick());
  }

  async #again() {
    if (!this.playing || this.#restarting) return;
    this.#restarting = true;
    await this.#rewind();
    this.#restarting = false;
    await this.#go();
  }

  /** Clips that are more than half a frame apart are brought together: gently when near, at once when far. */
  #align() {
    const lead = this.#lead;
    for (const clip of this.#timed) {
      if (clip === lead || clip.ended) continue;
      const frames = (clip.time - lead.time) * clip.fps;
      if (Math.abs(frames) > FAR * Math.max(1, this.#rate)) clip.seek(lead.time);
      else clip.rate = this.#rate * (Math.abs(frames) > 0.5 ? 1 - NUDGE * Math.sign(frames) : 1);
    }
  }

  #failed() {
    this.pause();
    this.dispatchEvent(new Event("failed"));
  }

  #changed() {
    this.dispatchEvent(new Event("change"));
  }
}

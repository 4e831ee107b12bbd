/** One clip: the picture, which frames of it were seen, and what to say where it cannot be shown. */

import { el, icon, put } from "./dom.js";
import { t } from "./strings.js";

const TYPES = { mp4: 'video/mp4; codecs="avc1.42E01E"', webm: "video/webm", webp: "image/webp" };
const RETRIES = 30;

const ending = (address) => address.split(".").pop();

/** Events: `failed` when it cannot be shown, `seen` at each new frame. */
export class Clip extends EventTarget {
  failed = false;
  /** Width over height. */
  shape = 1;
  element = el("div", { class: "clip", data: { state: "loading" } });
  #item;
  #video = null;
  #seen;
  #frame = -1;
  #tries = 0;
  #settle;
  #gone = false;

  /** `item` is one of an assignment's; loading starts at once, on the page or not. */
  constructor(item) {
    super();
    this.#item = item;
    this.#seen = new Uint8Array(Math.max(1, item.steps));
    this.ready = new Promise((resolve) => {
      this.#settle = resolve;
    });
    this.#load();
  }

  get fps() {
    return this.#item.fps || 30;
  }

  /** Seconds. */
  get duration() {
    return this.#video?.duration || this.#item.steps / this.fps || 0;
  }

  get time() {
    return this.#video?.currentTime ?? 0;
  }

  get ended() {
    return !this.#video || this.#video.ended || this.time >= this.duration - 0.5 / this.fps;
  }

  /** Share of the frames that were on the screen. */
  get watched() {
    return this.#seen.reduce((sum, one) => sum + one, 0) / this.#seen.length;
  }

  /** A still or moving image: no clock to be held to. */
  get loose() {
    return !this.#video;
  }

  set rate(rate) {
    if (this.#video && this.#video.playbackRate !== rate) this.#video.playbackRate = rate;
  }

  play() {
    return this.#video && !this.ended ? this.#video.play() : Promise.resolve();
  }

  pause() {
    this.#video?.pause();
  }

  /** Draw the picture as it is now onto a small canvas. */
  draw(canvas) {
    const source = this.#video ?? this.element.querySelector("img");
    const there = this.#video ? this.#video.readyState >= 2 : source?.complete;
    if (!there) return;
    const [width, height] = [canvas.width, canvas.width / this.shape];
    canvas.getContext("2d").drawImage(source, 0, (canvas.height - height) / 2, width, height);
  }

  /** Done when the picture is there. */
  seek(time) {
    const video = this.#video;
    if (!video) return Promise.resolve();
    const goal = Math.min(Math.max(0, time), Math.max(0, this.duration - 0.25 / this.fps));
    this.#frame = -1;
    return new Promise((resolve) => {
      setTimeout(resolve, 400);
      video.addEventListener("seeked", resolve, { once: true });
      video.currentTime = goal;
    });
  }

  /** Stop loading and forget the picture. */
  close() {
    this.#gone = true;
    this.#video?.pause();
    this.#video?.replaceChildren();
    this.#video?.load();
    put(this.element);
  }

  #load() {
    const films = this.#item.media.filter((address) => ending(address) !== "webp");
    if (films.length) this.#film(films);
    else this.#image(this.#item.media[0]);
  }

  #film(addresses) {
    const sources = addresses.map((src) => el("source", { src, type: TYPES[ending(src)] }));
    const video = el(
      "video",
      { muted: true, playsinline: true, preload: "auto", disablepictureinpicture: true, tabindex: "-1" },
      sources,
    );
    video.muted = true;
    video.setAttribute("aria-label", t("clip.name", { slot: this.#item.slot + 1 }));
    video.addEventListener("loadeddata", () => this.#shown(video.videoWidth / video.videoHeight));
    video.addEventListener("error", () => this.#missing());
    sources.at(-1).addEventListener("error", () => this.#missing());
    this.#video = video;
    this.#follow(video);
    put(this.element, video);
    video.load();
  }

  #image(src) {
    const image = el("img", { src, alt: t("clip.name", { slot: this.#item.slot + 1 }) });
    image.addEventListener("load", () => {
      this.#seen.fill(1);
      this.#shown(image.naturalWidth / image.naturalHeight);
    });
    image.addEventListener("error", () => this.#missing());
    this.#video = null;
    put(this.element, image);
  }

  #shown(shape) {
    this.element.dataset.state = "shown";
    if (shape > 0 && Number.isFinite(shape)) this.shape = shape;
    this.element.style.setProperty("--shape", String(this.shape));
    this.#settle(true);
  }

  #follow(video) {
    if (!("requestVideoFrameCallback" in video)) {
      video.addEventListener("timeupdate", () => this.#see(video.currentTime));
      return;
    }
    const next = (_now, { mediaTime }) => {
      this.#see(mediaTime);
      if (!this.#gone) video.requestVideoFrameCallback(next);
    };
    video.requestVideoFrameCallback(next);
  }

  /** A slow machine drops frames: a small step forward while playing counts as having passed over them. */
  #see(time) {
    const frame = Math.min(this.#seen.length - 1, Math.max(0, Math.round(time * this.fps)));
    const passed = frame - this.#frame;
    const from =
      this.#frame >= 0 && passed > 0 && passed <= this.fps * this.#video.playbackRate * 0.5 ? this.#frame : frame;
    this.#seen.fill(1, from, frame + 1);
    this.#frame = frame;
    this.element.dataset.frame = String(frame);
    this.dispatchEvent(new Event("seen"));
  }

  /** Ask the server why: a clip may be still being drawn, be impossible to draw, or be one this browser cannot play. */
  async #missing() {
    if (this.#gone || this.failed || this.element.dataset.state === "asking") return;
    this.element.dataset.state = "asking";
    const { again, reason } = await why(this.#item.media[0]);
    if (this.#gone) return;
    this.element.dataset.state = "loading";
    const image = this.#item.media.find((address) => ending(address) === "webp");
    if (again && this.#tries++ < RETRIES) setTimeout(() => this.#gone || this.#load(), again * 1000);
    else if (this.#video && image) this.#image(image);
    else this.#fail(reason);
  }

  #fail(reason) {
    this.failed = true;
    this.#video = null;
    this.element.dataset.state = "failed";
    put(
      this.element,
      el(
        "div",
        { class: "clip-error", testid: "clip-error", role: "alert" },
        icon("warning"),
        el("strong", { text: t("clip.broken") }),
        el("p", { text: reason }),
      ),
    );
    this.#settle(false);
    this.dispatchEvent(new Event("failed"));
  }
}

/** Why a clip does not load: {again: seconds until it may, or 0; reason: a sentence}. */
async function why(address) {
  try {
    const response = await fetch(address, { headers: { Range: "bytes=0-1" }, cache: "no-store" });
    if (response.ok) return { again: 0, reason: t("clip.unplayable") };
    if (response.status === 503)
      return { again: Number(response.headers.get("Retry-After")) || 2, reason: t("clip.late") };
    const said = await response.json().catch(() => ({}));
    return { again: 0, reason: typeof said.error === "string" ? said.error : t("clip.absent") };
  } catch {
    return { again: 3, reason: t("clip.offline") };
  }
}

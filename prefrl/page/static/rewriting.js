/** A response written anew: a field beside the one that was there, with the differences shown as they are made. */

import { Failed, post } from "./api.js";
import { compare } from "./diff.js";
import { el, icon, put } from "./dom.js";
import { cut, FIRST } from "./longtext.js";
import { t } from "./strings.js";

/** Milliseconds without a key before the server is asked how long it is. */
const PAUSE = 350;

/** The panel: {element, actions, begin(), close()}. `submit(shown, event)` is called with an answer. */
export class Rewriting {
  #id;
  #original;
  #submit;
  #mark;
  #keep;
  #timer = 0;
  #measured = { text: null, fault: "" };
  #field = el("textarea", { class: "draft-field", testid: "draft", "aria-label": t("write.field"), dir: "auto" });
  #behind = el("div", { class: "draft-behind", "aria-hidden": "true", dir: "auto" });
  #note = el("p", { class: "draft-note", role: "status", testid: "draft-note" });
  #count = el("span", { class: "draft-count", testid: "draft-count" });
  #send = el(
    "button",
    { type: "button", class: "primary", testid: "submit-text" },
    el("span", { text: t("write.send") }),
    el("kbd", { text: t("write.keys") }),
  );
  #off = false;

  /** `mark(runs)` shows in the old text what is gone; `keep(shown)` is called at each change. */
  constructor(item, { id, submit, earlier = null, mark, keep }) {
    this.#id = id;
    this.#original = (item.text ?? "").replace(/\r\n?/g, "\n"); // as a text field has it
    this.#submit = submit;
    this.#mark = mark;
    this.#keep = keep;
    this.#field.value = typeof earlier?.text === "string" ? earlier.text : this.#original;
    this.#field.addEventListener("input", () => this.#changed());
    this.#field.addEventListener("keydown", (event) => this.#key(event));
    this.#send.addEventListener("click", (event) => this.submit(event));
    const back = el("button", { type: "button", class: "link", text: t("write.reset"), testid: "draft-reset" });
    back.addEventListener("click", () => this.#reset());
    this.element = el(
      "section",
      { class: "slot writing", "aria-label": t("write.title"), testid: "writing" },
      el(
        "header",
        { class: "slot-head" },
        el("span", { class: "badge pen" }, icon("pen"), t("write.title")),
        this.#count,
      ),
      el("div", { class: "response draft" }, el("div", { class: "draft-sheet" }, this.#behind, this.#field)),
      el("footer", { class: "draft-foot" }, this.#note, back, this.#send),
    );
    this.#draw();
  }

  get actions() {
    return { write: () => this.focus() };
  }

  /** Ready to write in, where that brings up no keyboard over half of the screen. */
  begin() {
    if (!matchMedia("(pointer: coarse)").matches) this.focus();
    this.#measure();
  }

  focus() {
    this.#field.focus({ preventScroll: true });
    this.#field.setSelectionRange(this.#field.value.length, this.#field.value.length);
  }

  close() {
    clearTimeout(this.#timer);
  }

  submit(event) {
    if (this.#off || this.#fault) return void this.#draw();
    this.#submit({ text: this.#text }, event);
  }

  set disabled(off) {
    this.#off = off;
    this.#draw();
  }

  /** Less what the server takes in no text: NUL, and halves of characters. */
  get #text() {
    return this.#field.value.replace(/[\0\p{Cs}]/gu, "");
  }

  get #fault() {
    const text = this.#text;
    if (!text.trim()) return t("write.empty");
    if (text === this.#original) return t("write.same");
    return this.#measured.text === text ? this.#measured.fault : "";
  }

  #key(event) {
    if (event.key === "Escape") this.#field.blur();
    if (event.key !== "Enter" || !(event.ctrlKey || event.metaKey) || event.repeat) return;
    event.preventDefault();
    this.submit(event);
  }

  #reset() {
    this.#field.value = this.#original;
    this.#changed();
    this.focus();
  }

  #changed() {
    this.#keep(this.#text === this.#original ? null : { text: this.#text });
    this.#draw();
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => this.#measure(), PAUSE);
  }

  /** How long it is only the server can say; without a connection it says so when the text arrives. */
  async #measure() {
    const text = this.#text;
    if (!text) return;
    try {
      const found = await post("/api/drafts", { assignment_id: this.#id, shown: { text } });
      this.#measured = { text, fault: found.fault };
      this.#count.classList.toggle("over", found.length > found.longest);
      put(this.#count, t("write.length", { length: found.length, longest: found.longest }));
    } catch (error) {
      if (!(error instanceof Failed)) throw error;
      put(this.#count);
    }
    this.#draw();
  }

  #draw() {
    const [was, is] = [this.#original, this.#field.value].map((text) => cut(text, FIRST));
    const { first, second } = compare(was, is);
    this.#mark(first);
    // A field holds no marks: they stand behind it, in the same words at the same places.
    const runs = second.map((run) => (run.alone ? el("mark", { class: "alone" }, run.text) : run.text));
    put(this.#behind, runs, this.#field.value.slice(is.length), "\u200b");
    const fault = this.#fault;
    const untouched = this.#text === this.#original;
    put(this.#note, fault || t("write.ready"));
    this.#note.classList.toggle("bad", Boolean(fault) && !untouched);
    this.#send.disabled = this.#off || Boolean(fault);
  }
}

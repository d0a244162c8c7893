// What a job asks its operator: buttons, each with its key, or a text; beside it what cameras see.

import { capital, h, paint, refresh, say } from "../dom.js";

const LIVE_MS = 200;
const KEYS = { Enter: "enter", Escape: "esc", " ": "space" };
const questions = new Set();

// One key answers the question that is on the page, unless something is typed elsewhere.
document.addEventListener("keydown", (event) => {
  if (event.repeat || event.ctrlKey || event.altKey || event.metaKey || event.defaultPrevented) return;
  if (event.target.closest?.("input:not([type=range]), select, textarea, dialog")) return;
  const key = KEYS[event.key] ?? event.key;
  for (const question of questions) if (question.element.isConnected && question.press(key)) { event.preventDefault(); return; }
});

export class Question {
  constructor(ui) {
    this.ui = ui;
    this.element = h("div", { class: "ask", hidden: true });
    questions.add(this);
  }

  update({ number, state, facts }) {
    const asked = state === "running" ? facts.ask ?? null : null;
    this.job = number;
    this.asked = asked;
    this.element.hidden = !asked;
    refresh(this.element, [number, asked, this.ui.drives], () => (asked ? this.content(asked) : []));
    if (!asked) clearTimeout(this.timer);
  }

  content({ text, choices, sights }) {
    clearTimeout(this.timer);
    const disabled = !this.ui.drives;
    this.live = [];
    const pictures = sights.map((sight, i) => this.sight(sight, i));
    if (this.live.length) this.follow(this.asked);
    requestAnimationFrame(() => this.reveal());
    return [h("p", { class: "request", role: "alert" }, text),
      pictures.length ? h("div", { class: "sights" }, pictures) : null,
      choices.length ? h("div", { class: "row choices-of" }, choices.map((choice) => h("button", {
        class: choice.urgent ? "stop" : "", disabled, onclick: () => this.answer(choice.key),
      }, `${capital(choice.text)} `, h("kbd", {}, choice.key.length > 1 ? capital(choice.key) : choice.key))))
        : this.typed(disabled)].filter(Boolean);
  }

  // The field of an answer that is typed.
  typed(disabled) {
    const input = h("input", { type: "text", required: true, maxlength: "500", "aria-label": this.asked.text, disabled });
    const form = h("form", { class: "row" }, input, h("button", { class: "primary", disabled }, "Send"));
    form.addEventListener("submit", (event) => { event.preventDefault(); this.answer(input.value); });
    queueMicrotask(() => input.focus());
    return form;
  }

  // Scrolls so that the whole question is visible; again once its pictures have a size.
  reveal() { this.element.scrollIntoView({ block: "nearest" }); }

  press(key) {
    if (!this.asked || !this.ui.drives || !this.asked.choices.some((choice) => choice.key === key)) return false;
    this.answer(key);
    return true;
  }

  async answer(answer) {
    const { job, asked } = this;
    if (!asked) return;
    this.asked = null; // it is answered once
    for (const control of this.element.querySelectorAll("button, input")) control.disabled = true;
    const sent = await this.ui.attempt(() => this.ui.post("jobs/answer", { number: job, ask: asked.ask, answer }).then(() => true));
    if (!sent && this.asked === null) { delete this.element.dataset.key; this.update(this.ui.jobs.get(job)); }
  }

  // A camera: its picture, with the picture as which it has to look laid over it.
  sight({ camera, wanted, live }, i) {
    const query = { number: this.job, ask: this.asked.ask, sight: i };
    const title = wanted && live ? `${camera}: the start over the live picture` : wanted ? `${camera}: the start` : camera;
    const over = wanted ? h("img", { class: live ? "over" : "", src: this.ui.address("jobs/sight", { ...query, which: "wanted" }), alt: `${camera} at the start`, onload: () => this.reveal() }) : null;
    const caption = h("figcaption", {}, title);
    const layers = h("div", { class: "layers" });
    if (live) {
      const canvas = h("canvas", { role: "img", "aria-label": `${camera}, live` });
      this.live.push({ canvas, caption, title, query: { ...query, which: "live" } });
      layers.append(canvas);
    }
    if (over) layers.append(over);
    if (!over || !live) return h("figure", {}, layers, caption);
    const slider = h("input", { type: "range", min: "0", max: "100", value: opacity, "aria-label": `${camera}: opacity of the start` });
    const show = () => { opacity = slider.value; over.style.opacity = `${slider.value}%`; };
    slider.addEventListener("input", show);
    show();
    return h("figure", {}, layers, h("label", { class: "opacity" }, "Live", slider, "Start"), caption);
  }

  async follow(asked) {
    if (this.asked !== asked) return;
    if (this.element.isConnected) await Promise.all(this.live.map((each) => this.draw(each)));
    if (this.asked === asked) this.timer = setTimeout(() => this.follow(asked), LIVE_MS);
  }

  async draw({ canvas, caption, title, query }) {
    try {
      const response = await fetch(this.ui.address("jobs/sight", query));
      if (!response.ok) throw new Error((await response.json()).error);
      if (paint(canvas, await createImageBitmap(await response.blob()))) this.reveal();
      say(caption, title);
    } catch (error) {
      say(caption, `${title}: ${error.message}`);
    }
  }
}

let opacity = "50"; // of the next questions, too

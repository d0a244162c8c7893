// Recording, beside the pictures: begins, judges, discards and redoes episodes, each by a button or its key.

import { Cues } from "./cues.js";
import { h, refresh, say } from "./dom.js";

const GIB = 1 << 30;
const TWICE_MS = 600; // how long a second press of a key or button is ignored, until the first one's effect is visible

export class Record {
  constructor(section, page) {
    this.section = section;
    this.page = page;
    this.facts = h("p", { "aria-live": "polite" });
    this.line = h("div", { class: "line" });
    this.time = h("progress", { max: "1", value: "0", "aria-label": "Time of the episode" });
    this.cues = new Cues();
    this.pressed = null; // the last button: its key, and when [ms]
    this.problem = h("p", { class: "bad", role: "status" });
    section.append(this.line, this.time, this.problem);
  }

  update({ episode, services, episodes, successes, ended }) {
    const { page } = this;
    this.section.hidden = !episode && !episodes;
    this.time.hidden = !episode;
    if (!episode) {
      say(this.facts, `${count(episodes)}, ${successes} successful`);
      refresh(this.line, "none", () => [this.facts]);
      return;
    }
    this.cues.hear(episode);
    say(this.facts, words(episode, ended));
    this.facts.classList.toggle("recording", episode.recording);
    this.facts.setAttribute("aria-live", episode.recording ? "off" : "polite"); // the time runs
    say(this.problem, episode.failure);
    this.time.classList.toggle("idle", !episode.recording);
    this.time.value = Math.min(1, episode.elapsed_s / episode.max_duration_s);
    const redo = services.includes("/record_episode/redo") && episode.can_redo;
    const { recording, waiting, by_mode: byMode } = episode;
    const stopped = page.state?.estop || page.status.faults.length > 0;
    const complete = episode.wanted !== null && episode.saved >= episode.wanted;
    refresh(this.line, [recording, waiting, byMode, redo, page.operating, ended, stopped, complete], () => [this.facts, ...(ended ? [] : this.controls(episode, { redo, stopped, complete }))]);
  }

  controls({ recording, waiting, by_mode: byMode, prompt: before }, { redo, stopped, complete }) {
    const { page } = this;
    if (byMode) return [h("span", { class: "note" }, "The mode begins and ends its episodes itself.")];
    const button = (text, key, service, request, kind = "", disabled = false) => h("button", {
      class: kind, disabled: !page.operating || disabled, "data-key": key, onclick: () => this.once(key, () => page.drive.service(`/record_episode/${service}`, request)),
    }, text, h("kbd", { "aria-hidden": "true" }, key.toUpperCase()));
    const again = (text) => redo ? [button(text, "r", "redo", null, "", stopped)] : [];
    if (waiting) return [button("Cancel", "d", "discard", null)];
    if (recording) {
      return [button("Success", "s", "stop", "success", "primary"),
        button("Failure", "f", "stop", "failure"),
        button("Discard", "d", "discard", null, "danger"), ...again("Again")];
    }
    if (complete) {
      return [...again("Redo the last"), h("button", { class: "primary", disabled: !page.operating, "data-key": "e", onclick: () => page.drive.ask("finish") },
        "End the session", h("kbd", { "aria-hidden": "true" }, "E"))];
    }
    const prompt = h("input", { type: "text", "aria-label": "Task", placeholder: "task, e.g. pick the cube" });
    prompt.value = this.prompt ?? before;
    prompt.addEventListener("input", () => { this.prompt = prompt.value; });
    const form = h("form", {}, prompt, h("button", { class: "primary", disabled: !page.operating || stopped, title: stopped ? "Reset the robot first" : null, "data-key": "b" }, "Begin",
      h("kbd", { "aria-hidden": "true" }, "B")));
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      this.once("b", () => page.drive.service("/record_episode/start", { prompt: prompt.value || null, wait: true }));
      prompt.blur(); // so that keys judge the episode
    });
    return [form, ...again("Redo the last"), this.cues.choice];
  }

  // Runs the action of a button's key, unless it has just run.
  once(key, act) {
    const now = performance.now();
    if (key === this.pressed?.key && now - this.pressed.at < TWICE_MS) return;
    this.pressed = { key, at: now };
    act();
  }

  // The keys that press a button now, and its text.
  get keys() {
    return [...this.section.querySelectorAll("button[data-key]:not(:disabled)")].map((button) => [button.dataset.key.toUpperCase(), button.firstChild.textContent]);
  }

  // Presses the button with this key; false if there is none.
  press(key) {
    const button = this.section.querySelector(`button[data-key="${CSS.escape(key)}"]:not(:disabled)`);
    button?.click();
    return Boolean(button);
  }
}

const count = (number) => `${number} episode${number === 1 ? "" : "s"}`;

function words({ recording, waiting, saved, wanted, elapsed_s: elapsed, max_duration_s: longest, free_bytes: free, bytes_per_s: flow }, ended) {
  if (recording) return `● ${saved + 1}${wanted ? ` of ${wanted}` : ""} · ${elapsed.toFixed(1)} of ${longest} s`;
  if (waiting) return `Ready: ${saved + 1}${wanted ? ` of ${wanted}` : ""} begins when the robot follows you`;
  const minutes = flow ? Math.floor(free / flow / 60) : Infinity;
  const left = minutes < 120 ? ` · disk for ${minutes} min` : free < 5 * GIB ? ` · ${(free / GIB).toFixed(1)} GiB left` : "";
  return `${saved}${wanted ? ` of ${wanted}` : ""} saved${wanted && saved >= wanted && !ended ? " · the session ends" : ""}${left}`;
}

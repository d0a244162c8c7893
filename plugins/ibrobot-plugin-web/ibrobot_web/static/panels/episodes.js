// Recording: begin, end, judge and discard episodes.

import { h, refresh, say } from "../dom.js";

const MIB = 1 << 20;

export class EpisodesPanel {
  id = "episodes";
  title = "Episodes";

  constructor(page) { this.page = page; }

  mount(element) {
    this.facts = h("p", { "aria-live": "polite" });
    this.controls = h("div", {});
    this.topics = h("div", {});
    element.append(h("h2", {}, "Recording"), this.facts, this.controls, this.topics);
  }

  update(status) {
    const { page } = this;
    const { episode } = status;
    if (!episode) {
      say(this.facts, `Episodes: ${status.episodes}, successful: ${status.successes}. This run does not record. `
        + "To record, start it by the command ibrobot record, or add a recording section to its YAML.");
      refresh(this.controls, "none", () => []);
      refresh(this.topics, "none", () => []);
      return;
    }
    const left = episode.bytes_per_s ? ` · disk for ${Math.floor(episode.free_bytes / episode.bytes_per_s / 60)} min` : "";
    say(this.facts, episode.recording
      ? `Recording episode ${episode.episode}: ${episode.elapsed_s.toFixed(1)} of ${episode.max_duration_s} s${left}`
      : `${episode.saved}${episode.wanted ? ` of ${episode.wanted}` : ""} saved${left}`);
    this.facts.classList.toggle("recording", episode.recording);
    refresh(this.controls, [episode.recording, page.operating, episode.failure], () => this.buttons(episode));
    refresh(this.topics, [episode.rates_hz, episode.silent, episode.lost, Math.round(episode.free_bytes / MIB)], () => [
      h("table", {}, h("caption", {}, "Recorded topics"),
        h("thead", {}, h("tr", {}, ...["Topic", "Rate", "Lost"].map((name) => h("th", { scope: "col" }, name)))),
        h("tbody", {}, Object.entries(episode.rates_hz).map(([topic, rate]) => h("tr",
          { class: episode.silent.includes(topic) ? "bad" : "" }, h("th", { scope: "row" }, topic),
          h("td", {}, `${rate.toFixed(1)} Hz`), h("td", {}, String(episode.lost[topic] ?? 0)))))),
    ]);
  }

  buttons(episode) {
    const { page } = this;
    const button = (text, command, facts, kind = "") => h("button", {
      class: kind, disabled: !page.operating, onclick: () => page.command(command, facts),
    }, text);
    const failure = episode.failure ? h("p", { class: "bad" }, episode.failure) : null;
    if (episode.recording) {
      return [h("div", { class: "row" },
        button("End: success", "episode_stop", { outcome: "success" }, "primary"),
        button("End: failure", "episode_stop", { outcome: "failure" }),
        button("Discard", "episode_discard", {}, "danger")), failure].filter(Boolean);
    }
    const prompt = h("input", { type: "text", id: "prompt", placeholder: "as before" });
    prompt.value = this.prompt ?? episode.prompt;
    prompt.addEventListener("input", () => { this.prompt = prompt.value; });
    const form = h("form", { class: "row" }, h("label", { for: "prompt" }, "Task"), prompt,
      h("button", { class: "primary", disabled: !page.operating }, "Begin an episode"));
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      page.command("episode_start", { prompt: prompt.value });
    });
    return [form, failure].filter(Boolean);
  }
}

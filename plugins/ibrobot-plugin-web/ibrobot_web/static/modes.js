// The choice of the mode: each by what it does, and why it cannot be chosen where it cannot.

import { capital, confirm, h, refresh } from "./dom.js";

export class Modes {
  constructor(section, page) {
    this.page = page;
    this.summary = h("summary", {});
    this.list = h("div", { class: "modes", role: "group", "aria-label": "Modes" });
    this.element = h("details", {}, this.summary, this.list);
    section.append(this.element);
    document.addEventListener("pointerdown", ({ target }) => { if (!this.element.contains(target)) this.element.open = false; });
  }

  update({ robot: { modes }, mode: present }) {
    const { operating } = this.page;
    refresh(this.summary, [modes, present], () => `Mode: ${modes.find(({ name }) => name === present)?.label ?? present}`);
    refresh(this.list, [modes, present, operating], () => modes.map((mode) => h("button", {
      "aria-pressed": String(mode.name === present), disabled: !operating || Boolean(mode.unavailable), title: mode.name,
      onclick: () => this.choose(mode),
    }, mode.label, h("small", {}, mode.unavailable || (mode.label.includes(mode.name) ? "" : mode.name)))));
  }

  async choose(mode) {
    this.element.open = false;
    const { page } = this;
    if (mode.policy && !await confirm(`${capital(mode.label)}?`,
      "The robot moves by itself as soon as it is in this mode, until you stop it or change the mode.", "Let it move", { danger: false })) return;
    page.drive.service("/set_mode", mode.name, mode.label);
  }
}

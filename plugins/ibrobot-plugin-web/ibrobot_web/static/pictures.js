// The pictures: one of attention, large, and the others below it, each of which a click or its number makes large.

import { h } from "./dom.js";
import { Cameras } from "./cameras.js";

const KEY = "attention";

export class Pictures {
  constructor(section, page) {
    this.section = section;
    this.chosen = localStorage.getItem(KEY) ?? "3D";
    page.cameras = this.cameras = new Cameras(section, page, () => this.arrange());
    section.querySelector("#view").dataset.name = "3D";
    this.arrange();
  }

  update(status) { this.cameras.update(status); }

  // The names of all pictures, in their order.
  get names() { return [...this.section.querySelectorAll(":scope > .picture")].map(({ dataset }) => dataset.name); }

  get keys() { const { names } = this; return names.length > 1 ? names.map((name, i) => [String(i + 1), `Show ${name} large`]) : []; }

  arrange() {
    const pictures = [...this.section.querySelectorAll(":scope > .picture")];
    const chosen = pictures.find(({ dataset }) => dataset.name === this.chosen) ?? pictures[0];
    for (const [i, picture] of pictures.entries()) {
      if (!picture.querySelector(".swap")) {
        const { name } = picture.dataset;
        picture.append(h("button", { class: "swap", "aria-label": `Show ${name} large, key ${i + 1}`, title: `Show ${name} large (${i + 1})`, onclick: () => this.show(name) }));
      }
      picture.classList.toggle("attention", picture === chosen);
    }
    this.section.classList.toggle("alone", pictures.length < 2);
    this.section.style.setProperty("--others", Math.max(1, pictures.length - 1));
  }

  show(name) {
    this.chosen = name;
    localStorage.setItem(KEY, name);
    this.arrange();
  }

  // Makes a picture large by its number.
  press(key) {
    const name = /^[1-9]$/.test(key) ? this.names[Number(key) - 1] : undefined;
    if (name) this.show(name);
    return Boolean(name);
  }
}

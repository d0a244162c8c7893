// The form of a command, from what its owner declares: labels, words, units, bounds and defaults are all from the server.

import { capital, h, refresh } from "../dom.js";

export class Form {
  // `title` is on the button; `command` is whose form it is, by which the browser remembers what was entered; `submit`
  // gets the values by name.
  constructor(title, command, submit) {
    this.key = `entered ${command}`;
    this.fields = [];
    this.note = h("p", { class: "note" });
    this.first = h("div", { class: "fields form" });
    this.more = h("div", { class: "fields form gap" });
    this.others = h("details", { hidden: true }, h("summary", {}, "More options"), this.more);
    this.button = h("button", { class: "primary", disabled: true }, title);
    this.element = h("form", { class: "card" }, this.note, this.first, this.others, h("div", { class: "row" }, this.button));
    this.element.addEventListener("input", () => { this.suggest(); this.remember(); });
    this.element.addEventListener("submit", (event) => { event.preventDefault(); this.remember(); submit(this.values); });
  }

  get values() { return Object.fromEntries(this.fields.map(({ name, value }) => [name, value()])); }

  // Enters values by name; `alone`: what is suggested after them is suggested anew.
  enter(values, alone = false) {
    for (const field of this.fields) if (field.name in values) field.enter(values[field.name]);
    if (alone) for (const field of this.fields) if (field.suggest && !(field.name in values)) field.enter("");
    this.suggest();
  }

  // What a person entered, by name: neither what the form began with nor what it suggested.
  get entered() {
    const own = this.fields.filter((field) => !same(field.value(), field.initial) && !same(field.value(), field.suggested));
    return Object.fromEntries(own.map((field) => [field.name, { value: field.value(), listed: field.lists(field.value()) }]));
  }

  remember() { localStorage.setItem(this.key, JSON.stringify(this.entered)); }

  // Enters what a person had entered, without what was chosen from a list that has it no more.
  recall(entered) {
    for (const field of this.fields) {
      if (!Object.hasOwn(entered, field.name)) continue;
      const { value, listed } = entered[field.name];
      const left = [value].flat().filter((each) => !listed || field.lists(each));
      if (Array.isArray(value) ? left.length || !value.length : left.length) field.enter(Array.isArray(value) ? left : value);
    }
  }

  // Suggests a value for a field, unless a person entered another.
  propose(name, value) {
    const field = this.fields.find((each) => each.name === name);
    if (!field || (field.value() !== "" && field.value() !== field.suggested)) return;
    field.suggested = value;
    field.enter(value);
    this.suggest();
  }

  // Enters suggestions that follow from other fields, where nothing else was entered.
  suggest() {
    for (const field of this.fields) {
      if (!field.suggest || (field.value() !== "" && field.value() !== field.suggested)) continue;
      const { values } = this;
      let whole = true;
      field.suggested = field.suggest.replace(/\{(\w+)\}/g, (_, name) => {
        const part = [values[name]].flat()[0]?.split("/").at(-1).replace(/\.ya?ml$/, "");
        whole &&= Boolean(part);
        return part;
      });
      field.enter(whole ? field.suggested : "");
    }
  }

  // Shows the form; values that were entered stay as long as the fields are the same.
  show({ summary, missing, fields, known }, drives) {
    const lacking = fields.filter(({ names, required, open }) => required && !open && known[names]?.length === 0);
    this.button.disabled = !drives || Boolean(missing) || lacking.length > 0;
    refresh(this.note, [summary, missing, lacking], () => [missing ? h("span", { class: "problem" }, missing)
      : lacking.length ? `The opened folders contain nothing for: ${lacking.map(({ label }) => label).join(", ")}.` : summary]);
    refresh(this.first, [fields, known], () => {
      const entered = this.fields.length ? this.entered : JSON.parse(localStorage.getItem(this.key) ?? "{}");
      this.fields = fields.map((field) => new Field(field, known[field.names] ?? []));
      this.recall(entered);
      this.suggest();
      this.others.hidden = !fields.some(({ more }) => more);
      this.more.replaceChildren(...this.fields.filter(({ more }) => more).flatMap(({ elements }) => elements));
      return this.fields.filter(({ more }) => !more).flatMap(({ elements }) => elements);
    });
  }
}

class Field {
  constructor(field, known) {
    this.name = field.name;
    this.more = field.more;
    this.suggest = field.suggest;
    const id = `field-${field.name}`, help = h("small", { class: "help", id: `${id}-help` }, sentence(field));
    const described = { id, "aria-describedby": help.id };
    const choices = field.choices.length ? field.choices : known.map(({ value, text }) => [value, text]);
    const closed = choices.length && !field.open && field.names !== "robot";
    this.lists = (entered) => [entered].flat().every((each) => choices.some(([value]) => value === each));
    if (field.several && !choices.length && !field.names) {
      const input = h("input", { type: "text", placeholder: "several, with commas between them", ...described });
      this.elements = [h("label", { for: id }, field.label), h("div", {}, input, help)];
      this.value = () => input.value.split(",").map((text) => text.trim()).filter(Boolean);
      this.enter = (entered) => { input.value = [entered].flat().join(", "); };
      this.initial = this.value();
      return;
    }
    if (field.several) {
      const checked = field.choices.length && field.suggest ? [field.suggest] : field.default;
      this.suggest = "";
      const boxes = choices.map(([value, text]) => {
        const box = h("input", { type: "checkbox", value });
        box.checked = checked?.length ? checked.includes(value) : choices.length === 1 && field.required;
        return h("label", {}, box, ` ${text}`);
      });
      const group = h("div", { class: "choices", role: "group", "aria-label": field.label, "aria-describedby": help.id },
        boxes.length ? boxes : h("span", { class: "note" }, "none in the opened folders"));
      this.elements = [h("span", { class: "label" }, field.label), h("div", {}, group, help)];
      this.value = () => [...group.querySelectorAll("input:checked")].map(({ value }) => value);
      this.enter = (entered) => { for (const box of group.querySelectorAll("input")) box.checked = [entered].flat().includes(box.value); };
      this.initial = this.value();
      return;
    }
    const label = h("label", { for: id }, field.label);
    if (field.kind === "flag") {
      const box = h("input", { type: "checkbox", checked: field.default === true, ...described });
      this.elements = [label, h("div", { class: "flag" }, box, help)];
      this.value = () => box.checked;
      this.enter = (entered) => { box.checked = Boolean(entered); };
    } else if (closed) {
      const nothing = !field.required && field.default === null ? [["", "none"]] : [];
      const offered = [...nothing, ...choices];
      const select = h("select", described, offered.map(([value, text]) => h("option", { value, selected: value === field.default }, text)));
      this.elements = [label, h("div", {}, select, help)];
      this.value = () => select.value;
      this.enter = (entered) => { if (offered.some(([value]) => value === entered)) select.value = entered; };
    } else {
      const number = field.kind !== "text";
      const input = h("input", {
        type: number ? "number" : "text", value: field.default ?? "", required: field.required, min: field.min, max: field.max,
        step: number ? (field.kind === "whole" ? "1" : "any") : null, list: choices.length ? `${id}-list` : null, ...described,
      });
      const list = choices.length ? h("datalist", { id: `${id}-list` }, choices.map(([value, text]) => h("option", { value }, text))) : null;
      const unit = field.unit ? h("span", { class: "unit" }, field.unit) : null;
      this.elements = [label, h("div", {}, h("div", { class: "entry" }, input, unit), ...[list].filter(Boolean), help)];
      this.value = () => (number && input.value !== "" ? Number(input.value) : input.value);
      this.enter = (entered) => { input.value = entered; };
    }
    this.initial = this.value();
  }
}

const same = (one, other) => JSON.stringify(one) === JSON.stringify(other);

function sentence({ label, help, required }) {
  if (help.toLowerCase() === label.toLowerCase()) return "";
  return `${capital(help)}${required ? " (required)" : ""}`;
}

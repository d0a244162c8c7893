// Elements: h("button", {class: "primary", onclick: f}, "Text", child) makes one. Text is never markup, except that
// what stands between backticks is code.

import { words } from "./words.js";

const READ = ["aria-label", "placeholder", "title", "label"]; // properties that people read
const VERBATIM = ["code", "option", "pre", "textarea"]; // elements whose text is shown as it is

export function h(tag, properties = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (value === undefined || value === null || value === false) continue;
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (value === true) element.setAttribute(name, "");
    else element.setAttribute(name, READ.includes(name) ? words(value) : value);
  }
  const shown = children.flat().filter((child) => child !== null && child !== undefined).map(words);
  element.append(...(VERBATIM.includes(tag) ? shown : shown.flatMap(marked)));
  return element;
}

// A text as texts and elements: what stands between backticks, in one line, is code. Anything else stays as it is.
function marked(text) {
  if (typeof text !== "string") return [text];
  return text.split(/`([^`\n]+)`/).map((part, i) => {
    if (i % 2 === 0) return part;
    const code = document.createElement("code"); // not by `h`, which would translate a command that is also a word
    code.textContent = part;
    return code;
  }).filter((part) => part !== "");
}

// Sets text only if it changed, so that screen readers and the layout rest.
export function say(element, text) {
  const shown = h(element.localName, {}, text);
  if (element.innerHTML !== shown.innerHTML) element.replaceChildren(...shown.childNodes);
}

// Replaces an element's children only if the described content changed.
export function refresh(element, description, make) {
  const key = JSON.stringify(description);
  if (element.dataset.key === key) return;
  element.dataset.key = key;
  replace(element, make());
}

const CONTROLS = "a, button, input, select, textarea, summary, [tabindex='0']";
const nameOf = (control) => `${control.localName} ${control.getAttribute("aria-label") ?? (control.id || control.textContent)}`;

// Replaces an element's children. If one of them had the focus, the new child of the same name gets it, or else the
// element, so that a second key press does not activate another button.
export function replace(element, ...children) {
  const before = document.activeElement;
  const name = before !== element && element.contains(before) ? nameOf(before) : null;
  element.replaceChildren(...children.flat().map(words).flatMap(marked));
  if (name === null) return;
  const same = [...element.querySelectorAll(CONTROLS)].find((each) => nameOf(each) === name && !each.disabled);
  if (!same && !element.hasAttribute("tabindex")) element.tabIndex = -1;
  (same ?? element).focus({ preventScroll: true });
}

// A table: the names of its columns, and its rows. On a phone each row is a card, whose values have these names.
export function table(columns, rows, caption = null) {
  const heads = columns?.map((name) => h("th", { scope: "col" }, name));
  const body = h("tbody", {}, rows);
  if (heads) {
    for (const { cells } of body.rows) [...cells].forEach((cell, i) => { if (i && heads[i]) cell.dataset.of = heads[i].textContent; });
  }
  return h("table", {}, caption && h("caption", {}, caption), heads && h("thead", {}, h("tr", {}, heads)), body);
}

// A row of a table: texts, elements, or cells; the first one names the row.
export function row(cells, properties = {}) {
  return h("tr", properties, cells.map((cell, i) => {
    if (cell instanceof HTMLTableCellElement) return cell;
    return i ? h("td", {}, cell) : h("th", { scope: "row" }, cell);
  }));
}

// Gives an element the focus, unless another one has it: browsers drop the focus of elements that are disabled or replaced.
export function regain(element) { if (document.activeElement === document.body || !document.activeElement) element.focus({ preventScroll: true }); }

// A part that scrolls, by keys too.
export function scroll(label, ...content) {
  return h("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": label }, ...content);
}

export function problem(text) { return h("div", { class: "problem", role: "alert" }, text); }

export function capital(text) { return text.charAt(0).toUpperCase() + text.slice(1); }

// A time since 1970 [s] as date and time of day.
export function when(seconds) { return new Date(seconds * 1000).toLocaleString([], { dateStyle: "short", timeStyle: "short" }); }

// Draws a bitmap on a canvas, which takes its size; returns whether that changed.
export function paint(canvas, bitmap) {
  const resized = canvas.width !== bitmap.width || canvas.height !== bitmap.height;
  if (resized) Object.assign(canvas, { width: bitmap.width, height: bitmap.height });
  canvas.getContext("2d").drawImage(bitmap, 0, 0);
  bitmap.close();
  return resized;
}

// A question in the page's dialog; resolves with whether it was confirmed.
export function confirm(title, text, yes, { danger = true, no = "Cancel" } = {}) {
  const dialog = document.getElementById("dialog");
  dialog.replaceChildren(h("h2", { id: "dialog-title" }, title), h("p", {}, text), h("form", { method: "dialog", class: "row" },
    h("button", { class: danger ? "danger" : "primary", value: "yes" }, yes), h("button", { value: "no", autofocus: true }, no)));
  dialog.returnValue = "no";
  dialog.showModal();
  return new Promise((resolve) => dialog.addEventListener("close", () => resolve(dialog.returnValue === "yes"), { once: true }));
}

function isDark() {
  const { theme } = document.documentElement.dataset;
  return theme ? theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
}

export function switchTheme() {
  const theme = isDark() ? "light" : "dark";
  document.documentElement.dataset.theme = theme;
  localStorage.setItem("theme", theme);
}

const SHOWN_MS = { info: 5000, error: 15000 };
let announced;
// Removes all messages, e.g. when another view is shown.
export function clearToasts() { announced?.replaceChildren(); }

// A message for a few seconds, or for as long as it is pointed at. The same text once more replaces the first.
export function toast(text, kind = "info") {
  // On the page of a run they are above the pictures, where no control is.
  announced ??= (document.getElementById("stage") ?? document.body).appendChild(h("div", { class: "toasts", role: "status", "aria-live": "polite" }));
  const item = h("div", { class: `toast ${kind}` }, h("p", {}, text),
    h("button", { "aria-label": "Close", onclick: () => item.remove() }, "×"));
  const others = [...announced.children].filter((each) => each.firstChild.textContent !== item.firstChild.textContent);
  announced.replaceChildren(...others.slice(-2), item);
  const leave = () => { if (item.matches(":hover, :focus-within")) setTimeout(leave, 1000); else item.remove(); };
  setTimeout(leave, SHOWN_MS[kind]);
}

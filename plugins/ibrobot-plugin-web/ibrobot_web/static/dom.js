// Elements: h("button", {class: "primary", onclick: f}, "Text", child) makes one. Text is never markup.

export function h(tag, properties = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (value === undefined || value === null || value === false) continue;
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (value === true) element.setAttribute(name, "");
    else element.setAttribute(name, value);
  }
  element.append(...children.flat().filter((child) => child !== null && child !== undefined));
  return element;
}

// Sets text only if it changed, so that screen readers and the layout rest.
export function say(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

// Replaces an element's children only if the described content changed.
export function refresh(element, description, make) {
  const key = JSON.stringify(description);
  if (element.dataset.key === key) return;
  element.dataset.key = key;
  element.replaceChildren(...[make()].flat());
}

let announced;
// Removes all messages, e.g. when another view is shown.
export function clearToasts() { announced?.replaceChildren(); }

// A message for a few seconds; one that `stays`, as errors do, until the next one or a click.
export function toast(text, kind = "info", stays = kind === "error") {
  announced ??= document.body.appendChild(h("div", { class: "toasts", role: "status", "aria-live": "polite" }));
  const item = h("div", { class: `toast ${kind}` }, h("p", {}, text),
    h("button", { "aria-label": "Close", onclick: () => item.remove() }, "×"));
  announced.replaceChildren(...[...announced.children].slice(-2), item);
  if (!stays) setTimeout(() => item.remove(), 5000);
}

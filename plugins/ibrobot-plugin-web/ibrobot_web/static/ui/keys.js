// Keys of an episode that is played back: those of its buttons, space to play, arrows to step.

import { h } from "../dom.js";

// A button with its key.
export function keyed(text, key, act) {
  return h("button", { "data-key": key, onclick: act }, text, h("kbd", { "aria-hidden": "true" }, key.toUpperCase()));
}

// Acts on a key, unless something is typed or asked.
export function press(event, element, player) {
  if (event.ctrlKey || event.altKey || event.metaKey || event.defaultPrevented) return;
  if (event.target.closest?.("input, select, textarea, dialog")) return;
  const button = element.querySelector(`button[data-key="${CSS.escape(event.key.toLowerCase())}"]:not(:disabled)`);
  if (button) button.click();
  else if (event.key === " " && !event.target.closest?.("button, a, summary")) player.toggle();
  else if (event.key === "ArrowLeft" || event.key === "ArrowRight") player.step(event.key === "ArrowLeft" ? -1 : 1);
  else return;
  event.preventDefault();
}

// The log of the run, newest last.

import { h } from "../dom.js";

export class LogPanel {
  id = "log";
  title = "Log";

  constructor() { this.last = 0; }

  mount(element) {
    this.list = h("ol", { class: "log", tabindex: "0", "aria-label": "Log" });
    element.append(this.list);
  }

  update({ log }) {
    for (const line of log.filter(({ n }) => n > this.last)) {
      this.last = line.n;
      this.list.append(h("li", { class: line.level },
        h("time", {}, new Date(line.time * 1000).toLocaleTimeString()), ` ${line.text}`));
      while (this.list.children.length > 300) this.list.firstChild.remove();
      this.list.scrollTop = this.list.scrollHeight;
    }
  }
}

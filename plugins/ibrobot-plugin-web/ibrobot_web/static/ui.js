// The page without a running robot: header, navigation, and one view at a time.

import { clearToasts, h, refresh, say, switchTheme, toast } from "./dom.js";
import { RUNS, titled } from "./ui/job.js";
import { words } from "./words.js";

const $ = (id) => document.getElementById(id);

// What every view works with. `get` and `post` ask the server's module of the same name as the view.
class Ui extends EventTarget {
  constructor() {
    super();
    this.jobs = new Map(); // number -> {number, kind, title, state, facts, lines, …}
    this.session = { role: "watch", folders: [], views: [] };
    this.connected = null; // false once a connection was lost
  }

  get drives() { return this.session.role === "drive"; }

  get(path, query = {}) {
    const given = Object.entries(query).filter(([, value]) => value !== undefined && value !== null);
    return ask(`/api/${path}${given.length ? `?${new URLSearchParams(given)}` : ""}`);
  }

  post(path, facts = {}) {
    return ask(`/api/${path}`, {
      method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(facts),
    });
  }

  // The address of a picture or another file that a view's request answers with.
  address(path, query = {}) { return `/api/${path}?${new URLSearchParams(query)}`; }

  // Does something that may fail, and shows the error; returns undefined then.
  async attempt(act) {
    try {
      return await act();
    } catch (error) {
      toast(error.message, "error");
      return undefined;
    }
  }

  // Whether a run is starting and has no page yet: another start meanwhile would come from a button pressed twice.
  get startsRun() {
    const started = [...this.jobs.values()].some(({ kind, state, facts }) => RUNS.includes(kind) && state === "running" && !facts.url);
    return started || (this.begun !== undefined && !this.jobs.has(this.begun));
  }

  // Starts a run, and opens its page, as soon as it is ready, in a window that browsers permit only at a click.
  async openRun(start) {
    const opened = window.open("about:blank");
    const started = await this.attempt(start);
    this.begun = started?.number;
    if (!opened) return started;
    const follow = () => {
      const job = this.jobs.get(started?.number);
      const ended = !started || (job && job.state !== "running");
      if (job?.facts.url) opened.location.replace(this.runAddress(job.facts.url));
      else if (ended) opened.close();
      else opened.document.body.textContent = words(`The robot starts … ${job?.lines.at(-1) ?? ""}`);
      if (ended || job?.facts.url) this.removeEventListener("job", follow);
      if (job?.state === "failed") document.querySelector(".job .problem")?.scrollIntoView({ block: "center" });
    };
    this.addEventListener("job", follow);
    follow();
    return started;
  }

  // The address of a run's page, with the address of this one, to which its end leads back.
  runAddress(url) { return `${url}#${new URLSearchParams({ home: location.origin })}`; }

  follow() {
    const socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/api/jobs`);
    socket.onopen = () => {
      const again = this.connected === false;
      this.connected = true;
      this.jobs.clear();
      this.begun = undefined;
      showConnection();
      if (again) shown?.show?.(true, address()[1]); // what was shown may have changed
    };
    socket.onclose = () => { this.lose(); setTimeout(() => this.follow(), 1000); };
    socket.onmessage = ({ data }) => {
      const { job, lines } = JSON.parse(data);
      const known = this.jobs.get(job.number);
      job.lines = [...(known?.lines ?? []), ...lines].slice(-2000);
      this.jobs.set(job.number, job);
      showRunning();
      this.dispatchEvent(new CustomEvent("job", { detail: job }));
      shown?.job?.(job);
    };
  }

  // Hides what the page shows, which is out of date from now on. A server that was restarted has another address.
  async lose() {
    this.connected = false;
    showConnection();
    const known = await fetch("/api/session").then(({ status }) => status !== 401, () => true);
    if (!known) showConnection("this page belongs to a server that has ended: open the address that the new one shows");
  }
}

async function ask(address, options) {
  let response;
  try {
    response = await fetch(address, options);
  } catch {
    throw new Error("the server of this page does not answer: is ibrobot ui still running?");
  }
  const answer = response.headers.get("Content-Type")?.startsWith("application/json") ? await response.json() : null;
  if (!response.ok) {
    const error = new Error(answer?.error ?? (await response.text()));
    error.problems = answer?.problems ?? [];
    throw error;
  }
  return answer;
}

const ui = new Ui();
const views = new Map();
let shown, current = "";
window.ibrobot = ui; // for tests and for the console

// The address after # is VIEW or VIEW/REST; a view gets the rest.
function address() {
  const [name, ...rest] = location.hash.slice(1).split("/").map(decodeURIComponent); // the name of a command has blanks
  const known = ui.session.views.some((view) => view.name === name);
  return known ? [name, rest.join("/")] : [ui.session.views[0].name, ""];
}

async function showView() {
  const [name, rest] = address();
  const { within } = ui.session.views.find((view) => view.name === name);
  for (const link of $("nav").querySelectorAll("a")) {
    if (link.dataset.name === (within || name)) link.setAttribute("aria-current", "page");
    else link.removeAttribute("aria-current");
  }
  showTab();
  document.title = `ibrobot: ${words(ui.session.views.find((view) => view.name === name).title)}`;
  if (current !== name) {
    clearToasts();
    current = name;
    if (!views.has(name)) {
      const known = ui.session.views.find((view) => view.name === name);
      const { View } = await import(`./ui/${known.module}.js`);
      const view = new View(ui, known);
      view.element = h("div", { id: `view-${name.replaceAll(" ", "-")}` });
      view.mount(view.element);
      views.set(name, view);
    }
    if (current !== name) return; // left meanwhile
    shown?.show?.(false);
    shown = views.get(name);
    $("main").replaceChildren(shown.element);
  }
  shown?.show?.(true, rest);
}

// On a phone the navigation is one row that scrolls.
function showTab() {
  const tab = $("nav").querySelector("[aria-current]");
  if (tab) $("nav").scrollTo({ left: tab.offsetLeft - 60 });
}

function showConnection(why = "not connected: is ibrobot ui running?") {
  say($("connection"), ui.connected ? "" : why);
  $("connection").classList.toggle("bad", !ui.connected);
  $("main").hidden = ui.connected === false;
}

function showRunning() {
  const running = [...ui.jobs.values()].filter((job) => job.state === "running");
  refresh($("busy"), running.map((job) => [job.number, job.facts.url]), () => running.map((job) => (job.facts.url
    ? h("a", { class: "chip good", href: ui.runAddress(job.facts.url), target: "_blank" }, `${titled(job.title)}: open its page`)
    : h("a", { class: "chip good", href: "#jobs" }, titled(job.title)))));
}

$("theme").addEventListener("click", switchTheme);
window.addEventListener("hashchange", () => { showView(); $("main").focus(); });
window.addEventListener("resize", showTab);
window.addEventListener("focus", () => shown?.show?.(true, address()[1]));
ui.session = await ui.get("session");
say($("folder"), ui.session.folders.join(" · "));
say($("role"), ui.drives ? "" : "watching only");
const groups = Map.groupBy(ui.session.views.filter(({ within }) => !within), ({ group }) => group);
$("nav").append(...[...groups].map(([group, members]) => h("div", group ? { role: "group", "aria-label": group } : {},
  group ? h("span", { class: "heading", "aria-hidden": "true" }, group) : null,
  ...members.map(({ name, title }) => h("a", { href: `#${name}`, "data-name": name }, title)))));
ui.follow();
showView();

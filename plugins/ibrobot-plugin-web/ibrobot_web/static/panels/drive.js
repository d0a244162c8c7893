// Modes, reset, poses, goals and the tool.

import { h, refresh, toast } from "../dom.js";

const TOOL = [
  ["forward", { linear: [1, 0, 0] }], ["back", { linear: [-1, 0, 0] }],
  ["left", { linear: [0, 1, 0] }], ["right", { linear: [0, -1, 0] }],
  ["up", { linear: [0, 0, 1] }], ["down", { linear: [0, 0, -1] }],
  ["pitch up", { turn: [0, -1, 0] }], ["pitch down", { turn: [0, 1, 0] }],
  ["roll left", { turn: [0, 0, -1] }], ["roll right", { turn: [0, 0, 1] }],
];

const COMMANDS = {
  policy: "The policy commands the robot.", operator: "An operator commands the robot.",
  handover: "The robot brakes and holds until it is moved or given back.",
};

export class DrivePanel {
  id = "drive";
  title = "Drive";

  constructor(page) { this.page = page; }

  mount(element) {
    this.modes = h("div", { class: "row" });
    this.motion = h("div", { class: "motion" });
    this.plan = h("div", {});
    this.run = h("div", { class: "row" });
    element.append(h("h2", {}, "Mode"), this.modes, this.motion, this.plan, this.run);
  }

  update(status) {
    const { page } = this;
    const { operating } = page;
    refresh(this.modes, [status.robot.modes, status.mode, status.unavailable, operating], () =>
      status.robot.modes.map((mode) => h("button", {
        "aria-pressed": String(mode.name === status.mode), disabled: !operating || mode.name in status.unavailable,
        title: status.unavailable[mode.name] ?? mode.about,
        onclick: () => page.command("mode", { mode: mode.name }, `mode ${mode.name}`),
      }, mode.name, h("small", {}, mode.about))));
    const jogs = Boolean(page.jogs);
    refresh(this.motion, [jogs, page.operating, status.robot.tool, status.robot.poses, page.mode?.name, status.help], () => this.motions(status, jogs));
    const services = status.services;
    const dispatch = status.counts.dispatch;
    refresh(this.plan, [services, operating, dispatch?.smoothing, status.commander], () => this.plans(services, dispatch, status));
    refresh(this.run, [operating, page.links], () => [
      h("button", { disabled: !operating, onclick: () => page.command("reset") }, "Reset"),
      page.links.watch ? h("button", { onclick: () => this.copy() }, "Copy link for watching") : null,
      h("button", { disabled: !operating, onclick: () => this.end() }, "End the run"),
    ].filter(Boolean));
  }

  motions(status, jogs) {
    const { deadman } = this.page;
    if (!jogs) {
      const web = status.robot.modes.filter((mode) => mode.web).map((mode) => mode.name);
      const how = web.length ? `To jog from this page, enter mode ${web.join(" or ")}.`
        : "To jog from this page, the robot needs a mode whose teleop is of type web.";
      const missing = !this.page.operating ? "Only the page that operates can jog." : "Reset the fault to jog.";
      return [h("p", { class: "note" }, this.page.mode?.web ? missing : how),
        status.help && !this.page.mode?.web ? h("pre", {}, status.help) : null].filter(Boolean);
    }
    const hold = (name, motion) => deadman.button(h("button", {}, name), () => motion);
    return [
      h("p", { class: "note" }, "The robot moves while a button is held. Enter holds a button by keyboard."),
      ...(status.robot.tool ? [h("h3", {}, "Tool"), h("div", { class: "row" }, TOOL.map(([name, motion]) => hold(name, motion)))] : []),
      h("h3", {}, "Poses"),
      h("div", { class: "row" }, Object.keys(status.robot.poses).map((pose) => hold(pose, { pose }))),
    ];
  }

  plans(services, dispatch, status) {
    const { page } = this;
    const found = [];
    if (services.includes("goal")) found.push(...this.goals(services, status));
    if (services.includes("intervene") || (services.includes("smoothing") && dispatch)) found.push(h("h3", {}, "Policy"));
    if (services.includes("intervene")) {
      const taken = status.commander !== "policy";
      found.push(h("p", { class: "note" }, COMMANDS[status.commander] ?? ""), h("div", { class: "row" },
        h("button", { class: taken ? "" : "primary", disabled: !page.operating || taken,
          onclick: () => page.command("intervene", { take: true }) }, "Take the robot from the policy"),
        h("button", { class: taken ? "primary" : "", disabled: !page.operating || !taken,
          onclick: () => page.command("intervene", { take: false }) }, "Give it back")));
    }
    if (services.includes("smoothing") && dispatch) {
      const box = h("input", { type: "checkbox", disabled: !page.operating });
      box.checked = dispatch.smoothing;
      box.addEventListener("change", () => page.command("smoothing", { enabled: box.checked }));
      found.push(h("label", { class: "row" }, box, "blend chunks (smoothing)"));
    }
    return found;
  }

  goals(services, status) {
    const { page } = this;
    const goal = h("input", { type: "text", id: "goal", placeholder: "home, joint=rad,… or xyz=x,y,z", required: true });
    goal.value = this.goal ?? "";
    goal.addEventListener("input", () => { this.goal = goal.value; });
    this.setGoal = (text) => { goal.value = this.goal = text; this.preview(); };
    const go = () => page.command("goal", { goal: goal.value }, `goal ${goal.value}`);
    const form = h("form", { class: "row" }, h("label", { for: "goal" }, "Goal"), goal,
      services.includes("preview") ? h("button", { type: "button", disabled: !page.operating, onclick: () => this.preview() }, "Preview") : null,
      h("button", { class: "primary", disabled: !page.operating }, "Go"),
      h("button", { type: "button", disabled: !page.operating, onclick: () => page.command("cancel") }, "Cancel"));
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      go();
    });
    return [h("h3", {}, "Planner"), h("p", { class: "note" }, "Or drag the orange ball in 3D to a goal of the tool."), form,
      h("div", { class: "row" }, Object.keys(status.robot.poses).map((pose) =>
        h("button", { disabled: !page.operating, onclick: () => this.setGoal(pose) }, pose)))];
  }

  // Shows the path to the goal in 3D, without moving.
  async preview() {
    const { page } = this;
    if (!page.status.services.includes("preview")) return;
    try {
      const plan = await page.drive.command("preview", { goal: parsed(this.goal ?? "") });
      page.view.tell({ do: "plan", plan, positions: page.state.position, kept: true });
      toast(`The path takes ${plan.duration_s} s.`);
    } catch (error) {
      page.view.tell({ do: "plan", plan: { joints: [], rows: [] }, positions: page.state.position, kept: true });
      toast(`No path: ${error.message}`, "error");
    }
  }

  async copy() {
    const link = location.origin + this.page.links.watch;
    try {
      await navigator.clipboard.writeText(link);
    } catch {
      window.prompt("Link for watching", link);
    }
  }

  end() {
    const dialog = document.getElementById("dialog");
    dialog.replaceChildren(h("h2", { id: "dialog-title" }, "End the run?"),
      h("p", {}, "The robot stops as its YAML says. This page then shows nothing new."),
      h("form", { method: "dialog", class: "row" },
        h("button", { class: "danger", onclick: () => this.page.command("finish") }, "End the run"),
        h("button", { autofocus: true }, "Keep it running")));
    dialog.showModal();
  }
}

// A goal's text as an object: a pose's name, joint=rad,…, or xyz=x,y,z.
function parsed(text) {
  if (!text.includes("=")) return { pose: text.trim() };
  const xyz = /^\s*xyz\s*=(.*)$/.exec(text);
  if (xyz) return { xyz: xyz[1].split(",").map(Number) };
  return { joints: Object.fromEntries(text.split(",").map((each) => each.split("=")).map(([name, value]) => [name.trim(), Number(value)])) };
}

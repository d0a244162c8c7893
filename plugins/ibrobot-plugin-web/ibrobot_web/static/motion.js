// What moves the robot beside its joints: the tool, poses, goals, and a policy that is taken over.

import { h, refresh, toast } from "./dom.js";

const TOOL = [
  ["forward", { linear: [1, 0, 0] }], ["left", { linear: [0, 1, 0] }], ["up", { linear: [0, 0, 1] }],
  ["pitch up", { turn: [0, -1, 0] }], ["roll left", { turn: [0, 0, -1] }],
  ["back", { linear: [-1, 0, 0] }], ["right", { linear: [0, -1, 0] }], ["down", { linear: [0, 0, -1] }],
  ["pitch down", { turn: [0, 1, 0] }], ["roll right", { turn: [0, 0, 1] }],
];

const GO_TO = "/planning/go_to";
const INTERVENE = "/intervene";
const SMOOTHING = "/action_dispatcher/toggle_smoothing";

const COMMANDS = {
  policy: "The policy commands the robot.", operator: "An operator commands the robot.",
  handover: "The robot brakes and holds until it is moved or given back.",
};

export class Motion {
  constructor(section, page) {
    this.page = page;
    this.jog = h("div", {});
    this.plan = h("div", {});
    section.append(this.plan, this.jog);
  }

  update(status) {
    const { page } = this;
    const { services } = status;
    const dispatch = status.counts.dispatch;
    refresh(this.jog, [page.jogs, page.device, page.operating, status.robot.tool, status.robot.poses, status.mode, status.help, status.ended], () => this.motions(status));
    refresh(this.plan, [services, page.operating, dispatch?.smoothing, status.commander], () => this.plans(services, dispatch, status));
  }

  motions(status) {
    const { page } = this;
    if (status.ended) return [];
    if (!page.jogs.length) {
      const driven = status.robot.modes.filter(({ jogs, unavailable }) => Object.keys(jogs).length && !unavailable);
      const here = Object.keys(page.mode?.jogs ?? {}).length;
      const how = !page.operating ? "Only the page that operates can jog."
        : here ? "Reset the fault to jog."
        : driven.length ? `To jog from here, choose the mode “${driven[0].label}”.`
          : "To jog from here, the robot needs a mode whose teleop is of type web.";
      return [h("p", { class: "note" }, how), status.help && !here ? h("pre", {}, status.help) : null].filter(Boolean);
    }
    const hold = (name, motion) => page.deadman.button(h("button", {}, name), () => ({ device: page.device, ...motion }));
    return [
      page.jogs.length > 1 ? h("div", { class: "row", role: "group", "aria-label": "Arm" }, page.jogs.map((device) => h("button", {
        "aria-pressed": String(device === page.device), onclick: () => page.setDevice(device),
      }, page.groupOf(device)))) : null,
      h("p", { class: "note" }, "Hold a button, a slider or Enter to move."),
      ...(status.robot.tool ? [h("h3", {}, "Tool"), h("div", { class: "pad" }, TOOL.map(([name, motion]) => hold(name, motion)))] : []),
      h("h3", {}, "Poses"),
      h("div", { class: "row" }, Object.keys(status.robot.poses).map((pose) => hold(pose, { pose }))),
    ].filter(Boolean);
  }

  plans(services, dispatch, status) {
    const { page } = this;
    const found = [];
    if (services.includes(GO_TO)) found.push(...this.goals(services, status));
    if (services.includes(INTERVENE) || (services.includes(SMOOTHING) && dispatch)) found.push(h("h3", {}, "Policy"));
    if (services.includes(INTERVENE)) {
      const taken = status.commander !== "policy";
      found.push(h("p", { class: "note" }, COMMANDS[status.commander] ?? ""), h("div", { class: "row" },
        h("button", { class: taken ? "" : "primary", disabled: !page.operating || taken,
          onclick: () => page.drive.service(INTERVENE, true) }, "Take the robot"),
        h("button", { class: taken ? "primary" : "", disabled: !page.operating || !taken,
          onclick: () => page.drive.service(INTERVENE, false) }, "Give it back")));
    }
    if (services.includes(SMOOTHING) && dispatch) {
      const box = h("input", { type: "checkbox", disabled: !page.operating });
      box.checked = dispatch.smoothing;
      box.addEventListener("change", () => page.drive.service(SMOOTHING, box.checked));
      found.push(h("label", { class: "row" }, box, "blend chunks (smoothing)"));
    }
    return found;
  }

  goals(services, status) {
    const { page } = this;
    const goal = h("input", { type: "text", id: "goal", "aria-label": "Goal", placeholder: "home, joint=rad,… or xyz=x,y,z axis=down", required: true });
    goal.value = this.goal ?? "";
    goal.addEventListener("input", () => { this.goal = goal.value; });
    this.setGoal = (text) => { goal.value = this.goal = text; this.preview(); };
    const go = () => page.drive.service(GO_TO, { goal: goal.value }, `goal ${goal.value}`);
    const form = h("form", { class: "row" }, goal,
      h("button", { type: "button", disabled: !page.operating, onclick: () => this.preview() }, "Preview"),
      h("button", { class: "primary", disabled: !page.operating }, "Go"),
      h("button", { type: "button", disabled: !page.operating, onclick: () => page.drive.service("/planning/cancel") }, "Cancel"));
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      go();
    });
    return [h("h3", {}, "Goal"), h("p", { class: "note" }, "Drag the orange ball in 3D, choose a pose, or type."), form,
      h("div", { class: "row" }, Object.keys(status.robot.poses).map((pose) =>
        h("button", { disabled: !page.operating, onclick: () => this.setGoal(pose) }, pose)))];
  }

  // Shows the path to the goal in 3D, without moving.
  async preview(goal = this.goal ?? "") {
    const { page } = this;
    try {
      const plan = await page.drive.command("preview", { goal });
      page.view.tell({ do: "plan", plan, positions: page.state.position, kept: true });
      toast(`The path takes ${plan.duration_s} s.`);
    } catch (error) {
      page.view.tell({ do: "plan", plan: { joints: [], rows: [] }, positions: page.state.position, kept: true });
      toast(`No path: ${error.message}`, "error");
    }
  }
}

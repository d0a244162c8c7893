"""`ibrobot mcp`: runs a robot for an agent, over standard input and output."""

from __future__ import annotations

import attrs

from ibrobot_core.api import option
from ibrobot_core.app import LaunchRequest, ModeOptions, RunHooks, Runtime, installed_plugins, run_robot
from ibrobot_mcp.door import AgentDoor
from ibrobot_mcp.options import SECTION
from ibrobot_mcp.stdio import take_standard_pipes

TASKS = "tasks"
"""A section that serves tasks and their steps, which agents use, if a package offers it."""
DETECT = "detect"
"""A section that finds objects, likewise."""
WORLD = "world"
"""A section that has the objects of a scene, likewise: an agent names them in goals."""


@attrs.frozen(kw_only=True)
class RunMcp(ModeOptions):
    """Run the robot for an agent that speaks the Model Context Protocol over standard input and output.

    CONFIG is a robot YAML as for `ibrobot launch`. The agent looks, plans and stops at any time. It moves the robot
    only within what you grant by `ibrobot agent arm`. All that the run prints goes to standard error. It ends when the
    agent closes its connection.
    """

    mode: str | None = option(None, typed="--mode MODE", label=None, help="by default a mode with a planner")

    def __call__(self) -> None:
        robot = self.load(self.mode)
        mode = self.mode
        if mode is None:
            planning = [name for name, each in robot.control_modes.items() if each.planner is not None]
            mode = planning[0] if planning else None
        known = {each.type for each in installed_plugins().of_kind("section")}
        more = [f"{SECTION}={{http: false}}"] if SECTION not in robot.plugin_sections else []
        wanted = {DETECT, *([TASKS] if mode is not None else [])}
        more += [f"{each}={{}}" for each in sorted(wanted & known - set(robot.plugin_sections))]
        if robot.simulated and mode is not None and WORLD in known - set(robot.plugin_sections):
            more.append(f"{WORLD}={{scene: true}}")
        robot = self.load(mode, (*self.changes(), *more))
        pipes = take_standard_pipes() if not self.dry_run else None

        def hooks(runtime: Runtime) -> RunHooks:
            door = next(each for each in runtime.plan.components if isinstance(each, AgentDoor))
            door.pipes = pipes
            return RunHooks()

        run_robot(
            robot,
            LaunchRequest(self.lockstep, self.seed, self.duration, by_operator=robot.recording is not None),
            headless=self.viewer is None,
            dry_run=self.dry_run,
            as_json=self.as_json,
            make_hooks=hooks,
        )

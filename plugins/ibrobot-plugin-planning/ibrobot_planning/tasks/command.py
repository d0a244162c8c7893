"""`ibrobot task …`: check and perform tasks."""

from __future__ import annotations

import json
from typing import Any, override

import attrs

from ibrobot_core.api import IbrobotError, option
from ibrobot_core.app import (
    ConfigError,
    ConfigOptions,
    LaunchRequest,
    Problem,
    Registry,
    RobotConfig,
    RunHooks,
    RunOptions,
    Runtime,
    echo,
    installed_plugins,
    run_robot,
)
from ibrobot_planning.tasks.checks import CheckedTask, Situation, check_task
from ibrobot_planning.tasks.reading import TaskFile, find_task, read_task
from ibrobot_planning.tasks.result import TaskResult
from ibrobot_planning.tasks.runner import TaskRunner
from ibrobot_planning.world.section import SECTION, first_world, scene_objects

TASKS = "tasks"
"""The section whose component performs tasks."""


@attrs.frozen(kw_only=True)
class CheckTask(ConfigOptions):
    """Check the task in FILE for a robot, and move nothing.

    CONFIG is a robot YAML as for `ibrobot launch`. Checks names, limits, models and the order of the steps, and by
    inverse kinematics whether the tool can reach every goal whose position is known.
    """

    file: str = option(typed="FILE", help="the task")
    parameters: tuple[str, ...] = option((), typed="--param NAME=VALUE", help="value of a parameter of the task")

    def __call__(self) -> None:
        robot = self.load()
        checked = _checked(_read(self.file, self.parameters), robot, installed_plugins())
        steps = len(checked.file.task.steps)
        counted = f"{steps} step{'' if steps == 1 else 's'}"
        echo(f"{self.file}: {counted} for {robot.robot.name}, in mode {checked.mode.name}")


@attrs.frozen(kw_only=True)
class RunTask(RunOptions):
    """Perform the task in FILE, after a check of all of it.

    FILE is a path, or the name of a task that comes with ibrobot. CONFIG is a robot YAML as for `ibrobot launch`.
    Ctrl-C cancels the task: the robot slows down and holds.

    Exits as `ibrobot launch` does; with 3 if a step did not succeed.
    """

    file: str = option(typed="FILE", help="the task")
    parameters: tuple[str, ...] = option((), typed="--param NAME=VALUE", help="value of a parameter of the task")
    seed: int = option(0, help="first episode's seed; later ones add 1")

    def __call__(self) -> None:
        read, robot = _read(self.file, self.parameters), self.load()
        mode = _checked(read, robot, installed_plugins()).mode.name
        section = () if TASKS in robot.plugin_sections else (f"{TASKS}={{}}",)
        robot = self.load(mode, (*self.changes(), *section))
        run_robot(
            robot,
            LaunchRequest(self.lockstep, self.seed, by_operator=robot.recording is not None),
            headless=self.headless,
            as_json=self.as_json,
            make_hooks=lambda runtime: TaskHooks(runtime, read),
        )


def _read(file: str, parameters: tuple[str, ...]) -> TaskFile:
    path = find_task(file)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not UTF-8 text"
        raise ConfigError([Problem(path, 0, "", f"cannot be read: {reason}")]) from None
    return read_task(text, str(path), parameters)


def _checked(file: TaskFile, robot: RobotConfig, registry: Registry) -> CheckedTask:
    """Check a task without a run, with the objects at their first poses."""
    scene = scene_objects(robot)
    section = robot.plugin_sections.get(SECTION)
    world = first_world(section.options, scene) if section is not None else None
    # The seed of the run places these.
    movable = [thing.name for thing in scene if thing.topic]
    why = "" if robot.recording is not None else "the robot YAML has no section `recording`"
    return check_task(file, Situation(robot, world, movable, None, why, elsewhere=movable))


class TaskHooks(RunHooks):
    """Begins a task when the run has started, and ends the run with it."""

    def __init__(self, runtime: Runtime, file: TaskFile) -> None:
        self._session, self._file = runtime.session, file
        self._runner = next(each for each in runtime.plan.components if isinstance(each, TaskRunner))
        self._number: int | None = None
        # Counts as failed until the task begins.
        self._session.outcome.goals_failed += 1

    @override
    def step(self) -> None:
        session = self._session
        if session.finished.is_set():
            return
        if self._number is None:
            try:
                self._number = self._runner.run(self._file)
                session.outcome.goals_failed -= 1
            except IbrobotError as error:
                session.fail("task", error)
        elif self._result() is not None:
            session.finish()

    @override
    def line(self) -> str:
        return self._runner.line()

    @override
    def rows(self) -> list[tuple[str, str]]:
        return [("task", line)] if (line := self._runner.line()) else []

    @override
    def summary_rows(self) -> list[tuple[str, str]]:
        result = self._result()
        if result is None:
            return []
        rows = [("task", f"{result.name}: {result.outcome.lower()} after {result.duration_s:.1f} s")]
        for step in result.steps:
            facts = f" {json.dumps(dict(step.facts))}" if step.facts else ""
            detail = f": {step.why}" if step.message else facts
            rows.append(
                (
                    f"  step {step.number}",
                    f"{step.outcome.lower():9} {step.duration_s:5.1f} s  {step.name or step.kind}{detail}",
                )
            )
        return rows

    @override
    def facts(self) -> dict[str, Any]:
        result = self._result()
        return {"task": result.as_json() if result is not None else None}

    def _result(self) -> TaskResult | None:
        """The result, also of a task that the end of the run cancelled."""
        return None if self._number is None else self._runner.result(self._number)

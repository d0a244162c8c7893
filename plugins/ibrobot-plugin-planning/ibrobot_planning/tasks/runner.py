"""The component that performs tasks in a run, one at a time, through the services of the run."""

from __future__ import annotations

import json
import queue
import threading
from collections.abc import Callable, Mapping
from types import NoneType
from typing import Any, override

import attrs

from ibrobot_core.api import PlanningError, String, documented, option, seconds
from ibrobot_core.app import (
    CONTROL,
    NoRequest,
    RequestLimits,
    RunView,
    Service,
    SessionWorker,
    default_of,
    dump_yaml,
    fields,
)
from ibrobot_planning.execution.requests import Numbered, Results
from ibrobot_planning.tasks.checks import CheckedTask, Situation, check_task
from ibrobot_planning.tasks.format import Step, TaskStep
from ibrobot_planning.tasks.performing import Performance
from ibrobot_planning.tasks.reading import TaskFile, read_task
from ibrobot_planning.tasks.result import TaskResult
from ibrobot_planning.world.objects import OBSERVED
from ibrobot_planning.world.section import SECTION, scene_objects


@documented
@attrs.frozen
class RunTask:
    """A request to `/task/run` and `/task/check`."""

    task: str = option(help="the YAML of a task; it cannot read the environment")


_LIMITS = RequestLimits(text=20_000)
CHECK = Service(
    "/task/check", RunTask, NoneType, "Check a task; fails as /task/run would.", "task", _LIMITS, reads=True
)
RESULT: Service[Numbered, TaskResult | None] = Service(
    "/task/result", Numbered, TaskResult | None, "The result of a task; null until it has ended.", "number", reads=True
)
CANCEL = Service(
    "/task/cancel", NoRequest, NoneType, "End the present task: the robot slows down and holds.", urgent=True
)
RUN = Service(
    "/task/run",
    RunTask,
    int,
    "Check a task and begin it; answers with its number.",
    "task",
    _LIMITS,
    result=RESULT,
    cancel=CANCEL,
)
STEP = Service(
    "/task/step",
    TaskStep,
    int,
    "Check one step of a task and begin it: a motion, a grasp, a policy; answers with its number.",
    result=RESULT,
    cancel=CANCEL,
)
STATUS = "/task/status"
"""std_msgs/msg/String, latched: JSON with `task`, `step`, `steps`, `kind`, `name` and `state`."""
_POLL_S = 0.01
_STOP_S = 3.0
"""Longest wait for the robot to slow down at the end of a run [s]."""


def _read(request: RunTask) -> TaskFile:
    return read_task(request.task, "the request", expands=False)


def _of_step(step: TaskStep) -> TaskFile:
    return read_task(dump_yaml({"steps": [_given(step)]}), step.name or step.kind, expands=False)


def _given(value: Any) -> Any:
    """A step as plain data, without what has its default."""
    if attrs.has(type(value)):
        known = fields(type(value)).items()
        values = {name: (getattr(value, field.name), default_of(field)) for name, field in known}
        return {name: _given(each) for name, (each, default) in values.items() if each != default}
    if isinstance(value, Mapping):
        return {name: _given(each) for name, each in value.items()}
    return [_given(each) for each in value] if isinstance(value, tuple) else value


class TaskRunner(SessionWorker):
    """Performs tasks: `/task/run`, `/task/step`, `/task/check`, `/task/result` and `/task/cancel`."""

    def __init__(self, session: RunView) -> None:
        world = (SECTION,) if SECTION in session.config.plugin_sections else ()
        super().__init__(session, "tasks", f"performs tasks: {RUN.name}", (CONTROL, *world))
        self._running: Performance | None = None
        self._held: str | None = None
        """What the gripper held at the end of the last task."""
        self._results: Results[TaskResult] = Results("task", RUN.name)
        self._lock = threading.Lock()
        self._wake: queue.SimpleQueue[None] = queue.SimpleQueue()
        self._services: dict[Service[Any, Any], Callable[[Any], Any]] = {
            RUN: lambda request: self.run(_read(request)),
            STEP: lambda request: self.run(_of_step(request)),
            CHECK: lambda request: self._checked(_read(request)) and None,
            RESULT: lambda request: self.result(request.number),
            CANCEL: lambda _: self.cancel("cancelled"),
        }

    @override
    def setup(self) -> None:
        self.on_end.callback(self._end_early)
        for service, handler in self._services.items():
            self.session.bus.serve(service, handler)
            self.on_end.callback(self.session.bus.unserve, service)

    def run(self, file: TaskFile) -> int:
        """Check a task and begin it; returns its number.

        Raises:
            ConfigError: with all faults of the task.
            PlanningError: while another task runs.
        """
        stops = self.session.stops  # also one during the check ends the task
        checked = self._checked(file)
        with self._lock:
            if self._running is not None:
                raise PlanningError(f"task {self._running.number} is running; {CANCEL.name} ends it")
            number, held = self._results.number(), self._carried()
            self._running = running = Performance(self.session, checked, number, stops, self._show, held)
        self._wake.put(None)
        return running.number

    def cancel(self, why: str) -> None:
        """End the present task, if there is one: the robot slows down and holds."""
        running = self._running
        if running is not None and not running.cancelled:
            running.cancelled = why

    def line(self) -> str:
        """The step of the present task, in one line; empty without a task."""
        running = self._running
        if running is None:
            return ""
        task, number = running.checked.file.task, len(running.results)
        if number >= len(task.steps):
            return ""
        step = task.steps[number]
        return f"{task.name}: step {number + 1}/{len(task.steps)}, {step.name or step.kind}"

    @override
    def work(self, timeout_s: float) -> None:
        if self._running is None:
            if timeout_s > 0:
                try:
                    self._wake.get(timeout=timeout_s)
                except queue.Empty:
                    return
            if self._running is None:
                return
        elif timeout_s > 0:
            self.pause(min(timeout_s, _POLL_S))
        self._advance(self._running)

    def _advance(self, running: Performance) -> None:
        if running.advance():
            self._finish(running)

    def _checked(self, file: TaskFile) -> CheckedTask:
        session = self.session
        config, scene = session.config, scene_objects(session.config)
        why = ""
        if config.recording is None:
            why = "the robot YAML has no section `recording`"
        elif not session.request.by_operator:
            why = "this run records its episodes itself; `ibrobot task run` leaves that to the task"
        world = session.bus.call(OBSERVED).world if session.bus.serves(OBSERVED) else None
        movable = [thing.name for thing in scene if thing.topic]
        start = session.state.command if session.state is not None else None
        return check_task(
            file, Situation(config, world, movable, start, why, held=self._carried(), registry=self.session.registry)
        )

    def _carried(self) -> str | None:
        """What the last task has left in the gripper, and the world still has there."""
        world = self.session.bus.call(OBSERVED).world if self.session.bus.serves(OBSERVED) else None
        thing = world.objects.get(self._held) if world is not None and self._held is not None else None
        return self._held if thing is not None and thing.link is not None else None

    def result(self, number: int) -> TaskResult | None:
        """The result of a task; None until it has ended.

        Raises:
            PlanningError: for an unknown number, or a result that is no longer kept.
        """
        return self._results.of(number)

    def _finish(self, performance: Performance) -> None:
        session, name = self.session, performance.checked.file.task.name
        failed = next((each for each in performance.results if each.outcome in ("FAILED", "CANCELLED")), None)
        outcome: Any = "SUCCEEDED" if failed is None else failed.outcome
        message = "" if failed is None else f"step {failed.number} ({failed.name or failed.kind}): {failed.why}"
        duration_s = seconds(session.clock.now_ns() - performance.begun_ns)
        result = TaskResult(name, outcome, message, duration_s, tuple(performance.results))
        if result.success:
            session.log.info("task %s: done in %.1f s", name, duration_s)
        else:
            session.log.error("task %s %s: %s", name, outcome.lower(), message)
            session.outcome.goals_failed += 1
        with self._lock:
            self._running, self._held = None, performance.held
            self._results.end(performance.number, result)
        self._show(performance, None, outcome.lower())

    def _end_early(self) -> None:
        """At the end of the run: let the robot slow down, and end the task."""
        running = self._running
        if running is None:
            return
        self.cancel("the run ended")
        waits = 0.0
        while self._running is running:
            # In lockstep, time has stopped: a motion cannot end.
            if self.session.request.lockstep or waits > _STOP_S:
                running.end()
                self._finish(running)
                return
            self._advance(running)
            waits += _POLL_S
            threading.Event().wait(_POLL_S)

    def _show(self, performance: Performance, step: Step | None, state: str = "executing") -> None:
        """Publish the status of the task."""
        task = performance.checked.file.task
        position = len(performance.results) + (step is not None)
        status = {
            "task": task.name,
            "number": performance.number,
            "step": position,
            "steps": len(task.steps),
            "state": state,
        }
        if step is not None:
            status |= {"kind": step.kind, "name": step.name}
        self.session.bus.publish(STATUS, String(json.dumps(status)), latched=True)

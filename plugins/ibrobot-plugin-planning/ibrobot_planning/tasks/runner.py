"""The component that performs tasks in a run, one at a time, through the services of the run."""

from __future__ import annotations

import itertools
import json
import queue
import threading
from collections.abc import Callable, Generator, Mapping
from typing import Any, override

import attrs
import numpy as np

from ibrobot_core.api import (
    CONTROL,
    SET_MODE,
    CompressedImage,
    IbrobotError,
    Image,
    PlanCode,
    PlanningError,
    Session,
    SessionWorker,
    String,
    Vector,
    ns,
    seconds,
)
from ibrobot_planning.executors.options import GripperOptions
from ibrobot_planning.goal_text import Target
from ibrobot_planning.motion import MoveResult
from ibrobot_planning.source import CANCEL as CANCEL_MOTION
from ibrobot_planning.source import GO_TO
from ibrobot_planning.source import RESULT as MOTION_RESULT
from ibrobot_planning.tasks.checks import CheckedTask, Circumstances, check_task
from ibrobot_planning.tasks.format import (
    Action,
    GripperStep,
    LookStep,
    MoveStep,
    PolicyStep,
    RecordStep,
    Step,
    WaitStep,
)
from ibrobot_planning.tasks.goals import move_target
from ibrobot_planning.tasks.reading import TaskFile, read_task
from ibrobot_planning.tasks.result import StepOutcome, StepResult, TaskResult
from ibrobot_planning.world import SNAPSHOT, World
from ibrobot_planning.world_keeper import ATTACH, DETACH, SECTION, TOUCH, scene_objects

RUN = "/task/run"
"""Takes a task as YAML; checks all of it, begins, and answers with its number."""
CHECK = "/task/check"
"""Takes a task as YAML, and raises what `/task/run` would."""
RESULT = "/task/result"
"""Number of a task -> its `TaskResult`; None until it has ended."""
CANCEL = "/task/cancel"
"""Ends the present task: the robot slows down and holds."""
STATUS = "/task/status"
"""std_msgs/msg/String, latched: JSON with `task`, `step`, `steps`, `kind`, `name` and `state`."""
BEGIN_EPISODE, END_EPISODE = "/record_episode/start", "/record_episode/stop"
"""Services of a run that records: take a prompt, and an outcome."""
_POLL_S = 0.01
_KEPT = 100
"""Number of results kept for `RESULT`."""
_STOP_S = 3.0
"""Longest wait for the robot to slow down at the end of a run [s]."""
_GRASP_RAD = 0.01
"""A gripper that comes closer to its goal has grasped nothing, where its executor states no tolerance."""
_ALIVE_NS = ns(2.0)
"""How long the contract's topics may take to be alive after a policy has begun."""

type Steps = Generator[None, None, Mapping[str, Any]]


class _Cancelled(Exception):
    """The present task was cancelled."""


@attrs.define(eq=False)
class _Running:
    """A task in progress."""

    number: int
    checked: CheckedTask
    begun_ns: int
    cancelled: str = ""
    """Why it ends early; empty otherwise."""
    results: list[StepResult] = attrs.field(factory=list)
    performing: Generator[None, None, None] | None = None
    episode: RecordStep | None = None
    """The episode to record with the next policy."""


class TaskRunner(SessionWorker):
    """Performs tasks: `/task/run`, `/task/check`, `/task/result` and `/task/cancel`."""

    def __init__(self, session: Session) -> None:
        world = (SECTION,) if SECTION in session.config.plugin_sections else ()
        super().__init__(session, "tasks", f"performs tasks: {RUN}", (CONTROL, *world))
        self._numbers = itertools.count(1)
        self._running: _Running | None = None
        self._results: dict[int, TaskResult | None] = {}
        self._lock = threading.Lock()
        self._wake: queue.SimpleQueue[None] = queue.SimpleQueue()
        self._services: dict[str, Callable[[Any], Any]] = {
            RUN: lambda text: self.run(read_task(text, "the request")),
            CHECK: lambda text: self._checked(read_task(text, "the request")) and None,
            RESULT: self.result,
            CANCEL: lambda request: self.cancel("cancelled"),
        }

    @override
    def setup(self) -> None:
        for name, handler in self._services.items():
            self.session.bus.serve(name, handler)

    @override
    def teardown(self) -> None:
        for name in self._services:
            self.session.bus.unserve(name)
        self._end_early()
        super().teardown()

    def run(self, file: TaskFile) -> int:
        """Check a task and begin it; returns its number.

        Raises:
            ConfigError: with all faults of the task.
            PlanningError: while another task runs.
        """
        checked = self._checked(file)
        with self._lock:
            if self._running is not None:
                raise PlanningError(f"task {self._running.number} is running; {CANCEL} ends it")
            running = _Running(next(self._numbers), checked, self.session.clock.now_ns())
            running.performing = self._perform(running)
            self._running, self._results[running.number] = running, None
            while len(self._results) > _KEPT:
                self._results.pop(next(iter(self._results)))
        self._wake.put(None)
        return running.number

    def cancel(self, why: str) -> None:
        """End the present task, if there is one: the robot slows down and holds."""
        running = self._running
        if running is not None and not running.cancelled:
            running.cancelled = why

    def line(self) -> str:
        """Where the present task is, in one line; empty without a task."""
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

    def _advance(self, running: _Running) -> None:
        assert running.performing is not None
        try:
            next(running.performing)
        except StopIteration:
            self._finish(running)

    def _checked(self, file: TaskFile) -> CheckedTask:
        session = self.session
        config, scene = session.config, scene_objects(session.config, session.registry)
        why = ""
        if config.recording is None:
            why = "the robot YAML has no section `recording`"
        elif not session.request.by_operator:
            why = "this run records its episodes itself; `ibrobot task run` leaves that to the task"
        world = self._world() if session.bus.serves(SNAPSHOT) else None
        movable = [thing.name for thing in scene if thing.topic]
        start = session.state.command if session.state is not None else None
        return check_task(file, Circumstances(config, session.registry, world, movable, start, why))

    def result(self, number: int) -> TaskResult | None:
        """The result of a task; None until it has ended.

        Raises:
            PlanningError: for an unknown number.
        """
        if not isinstance(number, int) or number not in self._results:
            raise PlanningError(f"no task {number!r}; {RUN} answers with the number of a task")
        return self._results[number]

    def _finish(self, running: _Running) -> None:
        session, task = self.session, running.checked.file.task
        failed = next((each for each in running.results if each.outcome in ("FAILED", "CANCELLED")), None)
        outcome: Any = "SUCCEEDED" if failed is None else failed.outcome
        message = "" if failed is None else f"step {failed.number} ({failed.name or failed.kind}): {failed.message}"
        duration_s = seconds(session.clock.now_ns() - running.begun_ns)
        result = TaskResult(task.name, outcome, message, duration_s, tuple(running.results))
        if result.success:
            session.log.info("task %s: done in %.1f s", task.name, duration_s)
        else:
            session.log.error("task %s %s: %s", task.name, outcome.lower(), message)
            session.outcome.goals_failed += 1
        with self._lock:
            self._running, self._results[running.number] = None, result
        self._show(running, None, outcome.lower())

    def _end_early(self) -> None:
        """At the end of the run: let the robot slow down, and end the task."""
        running = self._running
        if running is None:
            return
        self.cancel("the run ended")
        waits = 0.0
        while self._running is running:
            # In lockstep time has stopped: a motion cannot end.
            if self.session.request.lockstep or waits > _STOP_S:
                assert running.performing is not None
                running.performing.close()
                running.results.append(self._not_done(running, "CANCELLED", running.cancelled))
                self._finish(running)
                return
            self._advance(running)
            waits += _POLL_S
            threading.Event().wait(_POLL_S)

    def _not_done(self, running: _Running, outcome: StepOutcome, message: str = "") -> StepResult:
        number = len(running.results)
        step = running.checked.file.task.steps[number]
        return StepResult(number + 1, step.kind, step.name, outcome, message)

    def _show(self, running: _Running, step: Step | None, state: str) -> None:
        """Publish where the task is."""
        task = running.checked.file.task
        number = len(running.results) + (step is not None)
        where = {"task": task.name, "number": running.number, "step": number, "steps": len(task.steps), "state": state}
        if step is not None:
            where |= {"kind": step.kind, "name": step.name}
        self.session.bus.publish(STATUS, String(json.dumps(where)), latched=True)

    def _perform(self, running: _Running) -> Generator[None, None, None]:
        """Perform the steps; yields once per poll."""
        session, steps = self.session, running.checked.file.task.steps
        for number, step in enumerate(steps, 1):
            session.log.info("step %d/%d: %s", number, len(steps), step.name or _text(step))
            self._show(running, step, "executing")
            begun_ns = session.clock.now_ns()
            outcome: StepOutcome = "SUCCEEDED"
            message, code, facts = "", "", {}
            try:
                if running.cancelled:
                    raise _Cancelled
                facts = dict((yield from self._act(running, step.action)))
            except _Cancelled:
                outcome, message = "CANCELLED", running.cancelled
            except _Failed as failure:
                outcome, message, code = "FAILED", str(failure), failure.code
            except IbrobotError as error:
                outcome, message = "FAILED", str(error)
                code = error.code.name if isinstance(error, PlanningError) else ""
            duration_s = seconds(session.clock.now_ns() - begun_ns)
            running.results.append(StepResult(number, step.kind, step.name, outcome, message, code, duration_s, facts))
            if outcome != "SUCCEEDED":
                break
        while len(running.results) < len(steps):
            running.results.append(self._not_done(running, "NOT_RUN"))

    def _act(self, running: _Running, action: Action) -> Steps:
        match action:
            case MoveStep():
                return self._move(running, action)
            case GripperStep():
                return self._grip(running, action)
            case WaitStep():
                return self._wait(running, action)
            case PolicyStep():
                return self._policy(running, action)
            case LookStep():
                return self._look(running, action)
            case RecordStep():
                return self._record(running, action)

    def _tick(self, running: _Running) -> Generator[None, None, None]:
        yield
        if running.cancelled:
            raise _Cancelled
        if self.session.faults:
            raise _Failed(f"the robot stopped: {self.session.faults[-1]}")

    def _world(self) -> World:
        if not self.session.bus.serves(SNAPSHOT):
            return World()
        world = self.session.bus.call(SNAPSHOT, None)
        assert isinstance(world, World)
        return world

    def _tool(self) -> Vector:
        """Present position of the tool, as commanded [m], shape (3,)."""
        from ibrobot_kinematics import robot_model

        session = self.session
        q = session.state.command if session.state is not None else session.measured().position
        return robot_model(session.config.robot).forward(q).position

    def _enter(self, mode: str) -> None:
        if self.session.mode != mode:
            self.session.bus.call(SET_MODE, mode)

    def _go(self, running: _Running, target: Target) -> Steps:
        """Move to a goal in the planning mode, and wait for the end."""
        bus = self.session.bus
        self._enter(running.checked.mode.name)
        number = bus.call(GO_TO, target)
        try:
            while (result := bus.call(MOTION_RESULT, number)) is None:
                yield from self._tick(running)
        except _Cancelled:
            if bus.serves(CANCEL_MOTION):  # otherwise the end of the mode stops the robot
                bus.call(CANCEL_MOTION, None)
            while bus.serves(MOTION_RESULT) and bus.call(MOTION_RESULT, number) is None:
                yield
            raise
        assert isinstance(result, MoveResult)
        if not result.success:
            code = result.code.name if result.code is not PlanCode.CONTROL_FAILED else ""
            raise _Failed(result.message, code)
        return {
            "position_error_m": round(result.position_error_m, 6),
            "orientation_error_rad": round(result.orientation_error_rad, 6),
        }

    def _move(self, running: _Running, step: MoveStep) -> Steps:
        bus = self.session.bus
        relative = any(goal.relative for goal in (step, *step.any, *step.line))
        tool = self._tool() if relative else None
        target = move_target(step, self.session.config.robot, running.checked.arm, self._world(), tool)
        if not step.touch:
            return (yield from self._go(running, target))
        bus.call(TOUCH, f"{{objects: {json.dumps(step.touch)}}}")
        try:
            return (yield from self._go(running, target))
        finally:
            bus.call(TOUCH, "{}")

    def _grip(self, running: _Running, step: GripperStep) -> Steps:
        session = self.session
        name = step.executor or running.checked.grippers[0]
        executor = session.config.executors[name]
        joint = executor.joints[0]
        target = Target(f"{joint}={step.position:g}", None, {joint: step.position})
        if step.release is not None:
            session.bus.call(DETACH, f"{{name: {json.dumps(step.release)}}}")
        yield from self._go(running, target)
        position = float(session.measured().position[session.config.robot.joint_names.index(joint)])
        if step.grasp is not None:
            options = executor.options
            least = options.goal_tolerance if isinstance(options, GripperOptions) else _GRASP_RAD
            if abs(position - step.position) <= least:
                raise _Failed(
                    f"nothing stopped the gripper on its way to {step.position:g} rad: no {step.grasp!r} there"
                )
            session.bus.call(ATTACH, f"{{name: {json.dumps(step.grasp)}}}")
        return {"position_rad": round(position, 4)}

    def _wait(self, running: _Running, step: WaitStep) -> Steps:
        clock = self.session.clock
        until_ns = clock.now_ns() + ns(step.seconds)
        while clock.now_ns() < until_ns:
            yield from self._tick(running)
        return {}

    def _policy(self, running: _Running, step: PolicyStep) -> Steps:
        session, episode, running.episode = self.session, running.episode, None
        self._enter(step.mode)
        begun_ns = session.clock.now_ns()
        solved, recorded, outcome = False, False, "unknown"
        try:
            while not solved and (since_ns := session.clock.now_ns() - begun_ns) < ns(step.seconds):
                if episode is not None and not recorded:
                    recorded = self._begin_episode(episode, late=since_ns > _ALIVE_NS)
                yield from self._tick(running)
                state = session.state
                solved = step.until == "success" and state is not None and bool(state.success)
            if episode is not None and not recorded:
                self._begin_episode(episode, late=True)
            outcome = "success" if solved else "failure"
            if step.until == "time":
                outcome = episode.outcome if episode is not None else ""
            elif not solved:
                raise _Failed(f"no success within {step.seconds:g} s")
        finally:
            # The mode, and with it the episode, ends here: nothing else moves the robot on.
            if recorded and session.bus.serves(END_EPISODE):
                session.bus.call(END_EPISODE, outcome)
            if session.bus.serves(SET_MODE):
                self._enter(running.checked.mode.name)
        return {"success": solved} if step.until == "success" else {}

    def _begin_episode(self, episode: RecordStep, *, late: bool) -> bool:
        """Begin an episode, unless topics of the contract are still silent; when `late`, that is an error."""
        try:
            self.session.bus.call(BEGIN_EPISODE, episode.prompt)
        except IbrobotError:
            if late:
                raise
            return False
        return True

    def _look(self, running: _Running, step: LookStep) -> Steps:
        if step.camera is not None:
            return (yield from self._image(running, step.camera, step.timeout))
        assert step.object is not None
        world = self._world()
        place = _place(world, step.object)
        facts: dict[str, Any] = {"position_m": np.round(place, 4).tolist()}
        if step.near is not None and step.within is not None:
            away = float(np.linalg.norm(place - _place(world, step.near)))
            facts["distance_m"] = round(away, 4)
            if away > step.within:
                raise _Failed(f"{step.object!r} is {away:.3f} m from {step.near!r}; at most {step.within:g} m asked")
        return facts

    def _image(self, running: _Running, camera: str, timeout_s: float) -> Steps:
        session = self.session
        begun_ns = session.clock.now_ns()
        images = session.bus.subscribe(f"/camera/{camera}/image_raw", 1)
        try:
            while session.clock.now_ns() - begun_ns < ns(timeout_s):
                received = images.get()
                message = received.message if received is not None else None
                if isinstance(message, Image | CompressedImage) and message.header.stamp_ns >= begun_ns:
                    return {"topic": images.topic, "stamp_ns": message.header.stamp_ns}
                yield from self._tick(running)
        finally:
            images.close()
        raise _Failed(f"no image of camera {camera!r} within {timeout_s:g} s")

    def _record(self, running: _Running, step: RecordStep) -> Steps:
        running.episode = step
        yield from ()
        return {}


class _Failed(Exception):
    """A step failed.

    Args:
        message: why, in one sentence.
        code: MoveIt's name of the error, or empty.
    """

    def __init__(self, message: str, code: str = "") -> None:
        super().__init__(message)
        self.code = code


def _place(world: World, name: str) -> np.ndarray[Any, np.dtype[np.float64]]:
    thing = world.named(name)
    if thing.link is not None:
        raise _Failed(f"{name!r} is attached to {thing.link}; release it before a look")
    p = thing.pose.position
    return np.array([p.x, p.y, p.z])


def _text(step: Step) -> str:
    match step.action:
        case GripperStep(position=position):
            return f"gripper to {position:g} rad"
        case WaitStep(seconds=duration):
            return f"wait {duration:g} s"
        case PolicyStep(mode=mode):
            return f"run_policy {mode}"
        case _:
            return step.kind

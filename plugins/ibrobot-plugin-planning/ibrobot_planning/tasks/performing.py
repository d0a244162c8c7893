"""Performs the steps of a checked task, one after another, through the services of the run."""

from __future__ import annotations

import contextvars
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from ibrobot_ros2.offers import SET_MODE

from ibrobot_core.api import CompressedImage, IbrobotError, Image, PlanningError, Vector, ns, seconds
from ibrobot_core.app import RunView
from ibrobot_planning.execution.motions import commanded
from ibrobot_planning.execution.requests import GoTo, MoveResult, Numbered, PlanAhead, PlanAnswer
from ibrobot_planning.execution.services import PLAN_GOAL
from ibrobot_planning.execution.source import CANCEL as CANCEL_MOTION
from ibrobot_planning.execution.source import GO_TO
from ibrobot_planning.execution.source import RESULT as MOTION_RESULT
from ibrobot_planning.executors.options import GripperOptions
from ibrobot_planning.goals.grammar import Target, object_pose
from ibrobot_planning.tasks.checks import CheckedTask
from ibrobot_planning.tasks.format import (
    Alternatives,
    GripperStep,
    LookStep,
    MoveStep,
    PolicyStep,
    RecordStep,
    Step,
    WaitStep,
)
from ibrobot_planning.tasks.result import StepOutcome, StepResult
from ibrobot_planning.world.objects import World, observed_world, world_of
from ibrobot_planning.world.options import Attached, Detached, Touched
from ibrobot_planning.world.section import ATTACH, DETACH, TOUCH

BEGIN_EPISODE, END_EPISODE = "/record_episode/start", "/record_episode/stop"
"""Services of a run that records: take a prompt, and an outcome."""
_GRASP_RAD = 0.01
"""A gripper that comes closer to its goal has grasped nothing; used if its executor has no tolerance."""
_ALIVE_NS = ns(2.0)
"""How long the contract's topics may stay silent after a recorded step has begun."""

type Steps = Generator[None, None, Mapping[str, Any]]


class Cancelled(Exception):
    """The present task was cancelled."""


class StepFailed(Exception):
    """A step failed.

    Args:
        message: why, in one sentence.
        code: MoveIt's name of the error, or empty.
    """

    def __init__(self, message: str, code: str = "") -> None:
        super().__init__(message)
        self.code = code


class Performance:
    """One performance of a task.

    Args:
        session: the run.
        checked: the task.
        number: its number.
        stops: number of emergency stops when it was requested; it fails after a newer one.
        begins: called with this and each step before it begins.
        held: what the gripper holds at the beginning.

    Attributes:
        begun_ns: when it began [ns].
        cancelled: why it ends early; empty otherwise.
        held: what the gripper holds.
        results: results of the steps that have ended.
    """

    def __init__(
        self, session: RunView, checked: CheckedTask, number: int, stops: int,
        begins: Callable[[Performance, Step], None], held: str | None = None,
    ) -> None:  # fmt: skip
        self._session = session
        self.checked, self.number = checked, number
        self._begins = begins
        self.begun_ns = session.clock.now_ns()
        self.cancelled = ""
        self.results: list[StepResult] = []
        self._episode: RecordStep | None = None
        """The episode to record with the next policy."""
        self._recording = False
        """Whether an episode of the task is being recorded."""
        self._stops = stops
        self.held = held
        self._context = contextvars.copy_context()
        """That of the caller, so that what an agent begins is its own to the end."""
        self._arm = self._perform()

    def advance(self) -> bool:
        """Go on with the steps without waiting; returns whether the task has ended."""
        return self._context.run(next, self._arm, True) is True

    def end(self) -> None:
        """End the present step here, as cancelled."""
        self._arm.close()
        self.results.append(self._not_done("CANCELLED", self.cancelled))
        self._end_recording("unknown")

    def _perform(self) -> Generator[None, None, None]:
        """Perform the steps; yields once per poll."""
        session, steps = self._session, self.checked.file.task.steps
        for number, step in enumerate(steps, 1):
            session.log.info("step %d/%d: %s", number, len(steps), step.name or _text(step))
            self._begins(self, step)
            begun_ns = session.clock.now_ns()
            outcome: StepOutcome = "SUCCEEDED"
            message, code, facts = "", "", {}
            try:
                self._check()
                while observed_world(session.bus).is_awaited:
                    yield from self._tick()
                facts = dict((yield from self._act(step)))
            except Cancelled:
                outcome, message = "CANCELLED", self.cancelled
            except (StepFailed, IbrobotError) as error:
                outcome, message, code = "FAILED", str(error), _code(error)
            duration_s = seconds(session.clock.now_ns() - begun_ns)
            self.results.append(StepResult(number, step.kind, step.name, outcome, message, code, duration_s, facts))
            if outcome != "SUCCEEDED":
                break
        self._end_recording({"SUCCEEDED": "success", "FAILED": "failure"}.get(self.results[-1].outcome, "unknown"))
        while len(self.results) < len(steps):
            self.results.append(self._not_done("NOT_RUN"))

    def _not_done(self, outcome: StepOutcome, message: str = "") -> StepResult:
        number = len(self.results)
        step = self.checked.file.task.steps[number]
        return StepResult(number + 1, step.kind, step.name, outcome, message)

    def _act(self, step: Step) -> Steps:
        self._check()
        kinds: dict[str, Callable[[Any], Steps]] = {
            "move": self._move,
            "gripper": self._grip,
            "wait": self._wait,
            "run_policy": self._policy,
            "look": self._look,
            "record": self._record,
            "alternatives": self._alternatives,
        }
        return kinds[step.kind](step.action)

    def _tick(self) -> Generator[None, None, None]:
        yield
        self._check()

    def _check(self) -> None:
        """Check that the task may go on.

        Raises:
            Cancelled: if it was cancelled.
            StepFailed: if the robot has stopped, also if it was reset since.
        """
        if self.cancelled:
            raise Cancelled
        if self._session.faults:
            raise StepFailed(f"the robot stopped: {self._session.faults[-1]}")
        if self._session.stops != self._stops:  # it was reset between two polls
            raise StepFailed("the robot stopped: an emergency stop")

    def _enter(self, mode: str, prompt: str = "") -> None:
        if prompt or self._session.mode != mode:  # the policy of the present mode may have another prompt
            self._session.bus.call(SET_MODE, {"mode": mode, "prompt": prompt})

    # Steps.

    def _alternatives(self, alternatives: Alternatives) -> Steps:
        """Perform the first list of steps that succeeds; lists whose first motions cannot be planned are skipped.

        All fail if the robot stops, or if a list fails after it has grasped or released something.
        """
        failures: list[StepFailed | IbrobotError] = []
        held = self.held
        for number, steps in enumerate(alternatives, 1):
            self._enter(self.checked.mode.name)
            try:
                self._check_ahead(steps)
                for each in steps:
                    yield from self._act(each)
            except (StepFailed, IbrobotError) as error:
                self._episode = None
                if self._session.faults or self._session.stops != self._stops or self.held != held:
                    raise
                failures.append(error)
                self._session.log.info("alternative %d of %d: %s", number, len(alternatives), error)
            else:
                return {"alternative": number}
        reasons = "; ".join(f"alternative {number}: {error}" for number, error in enumerate(failures, 1))
        raise StepFailed(f"no alternative succeeded: {reasons}", _code(failures[0]))

    def _check_ahead(self, steps: Sequence[Step]) -> None:
        """Plan the motions of steps, each from the end of the previous one, up to the first step that is unpredictable.

        Raises:
            StepFailed: if one cannot be planned.
        """
        robot, bus = self._session.config.robot, self._session.bus
        q = commanded(self._session).copy()
        for step in steps:
            action = step.action
            if isinstance(action, GripperStep | PolicyStep):
                return
            if not isinstance(action, MoveStep):
                continue
            target = self._target(action, q)
            with self._touching(action):
                answer = bus.call(PLAN_GOAL, PlanAhead(target, dict(zip(robot.joint_names, q.tolist(), strict=True))))
            assert isinstance(answer, PlanAnswer)
            if answer.trajectory is None:
                raise StepFailed(answer.message, answer.code.name)
            q[robot.indices(answer.trajectory.joint_names)] = answer.trajectory.points[-1].positions

    def _target(self, step: MoveStep, q: Vector) -> Target:
        """The goal of a motion that begins at positions `q` [rad], shape (J,)."""
        from ibrobot_kinematics import robot_model

        robot, tool = self._session.config.robot, None
        if any(goal.relative for goal in (step, *step.any, *step.line)):
            tool = robot_model(robot).forward(q).position
        return step.target(robot, self.checked.arm, world_of(self._session.bus), tool)

    @contextmanager
    def _touching(self, step: MoveStep) -> Iterator[None]:
        """Let the hand touch what a step names."""
        bus = self._session.bus
        if step.touch:
            bus.call(TOUCH, Touched(tuple(step.touch)))
        try:
            yield
        finally:
            if step.touch:
                bus.call(TOUCH)

    def _go(self, target: Target) -> Generator[None, None, MoveResult]:
        """Move to a goal in the planning mode, and wait for the end."""
        bus = self._session.bus
        self._enter(self.checked.mode.name)
        number = bus.call(GO_TO, GoTo(target))
        try:
            while (result := bus.call(MOTION_RESULT, Numbered(number))) is None:
                yield from self._tick()
        except Cancelled:
            if bus.serves(CANCEL_MOTION):  # otherwise the end of the mode stops the robot
                bus.call(CANCEL_MOTION)
            while bus.serves(MOTION_RESULT) and bus.call(MOTION_RESULT, Numbered(number)) is None:
                yield
            raise
        assert isinstance(result, MoveResult)
        if not result.success:
            raise StepFailed(result.message, result.code.name)
        return result

    def _move(self, step: MoveStep) -> Steps:
        target = self._target(step, commanded(self._session))
        with self._touching(step):
            result = yield from self._go(target)
        facts: dict[str, Any] = {
            "position_error_m": round(result.position_error_m, 6),
            "orientation_error_rad": round(result.orientation_error_rad, 6),
        }
        if step.any:
            facts["alternative"] = result.alternative + 1
        if step.line:
            facts["fraction"] = round(result.fraction, 3)
        return facts

    def _grip(self, step: GripperStep) -> Steps:
        session = self._session
        name = step.executor or self.checked.grippers[0]
        executor = session.config.executors[name]
        joint = executor.joints[0]
        target = Target(f"{joint}={step.position:g}", None, {joint: step.position})
        if step.release is not None:
            session.bus.call(DETACH, Detached(step.release))
            self.held = None
        yield from self._go(target)
        position = float(session.measured().position[session.config.robot.joint_names.index(joint)])
        if step.grasp is not None:
            options = executor.options
            least = options.goal_tolerance if isinstance(options, GripperOptions) else _GRASP_RAD
            if abs(position - step.position) <= least:
                raise StepFailed(
                    f"nothing stopped the gripper on its way to {step.position:g} rad: no {step.grasp!r} there"
                )
            session.bus.call(ATTACH, Attached(step.grasp))
            self.held = step.grasp
        return {"position_rad": round(position, 4)}

    def _wait(self, step: WaitStep) -> Steps:
        clock = self._session.clock
        until_ns = clock.now_ns() + ns(step.seconds)
        while clock.now_ns() < until_ns:
            yield from self._tick()
        return {}

    def _policy(self, step: PolicyStep) -> Steps:
        session, episode, self._episode = self._session, self._episode, None
        self._enter(step.mode, step.prompt)
        begun_ns = session.clock.now_ns()
        solved, recorded, outcome = False, False, "unknown"
        try:
            while not solved and (since_ns := session.clock.now_ns() - begun_ns) < ns(step.seconds):
                if episode is not None and not recorded:
                    recorded = self._begin_episode(episode, late=since_ns > _ALIVE_NS)
                yield from self._tick()
                state = session.state
                solved = step.until == "success" and state is not None and bool(state.success)
            if episode is not None and not recorded:
                self._begin_episode(episode, late=True)
            outcome = "success" if solved else "failure"
            if step.until == "time":
                outcome = episode.outcome if episode is not None else ""
            elif not solved:
                raise StepFailed(f"no success within {step.seconds:g} s")
        finally:
            # Leave the mode, so that the policy stops.
            if recorded and session.bus.serves(END_EPISODE):
                session.bus.call(END_EPISODE, outcome)
            if session.bus.serves(SET_MODE):
                self._enter(self.checked.mode.name)
        return {"success": solved} if step.until == "success" else {}

    def _look(self, step: LookStep) -> Steps:
        if step.camera is not None:
            return (yield from self._image(step.camera, step.timeout))
        assert step.object is not None
        world = world_of(self._session.bus)
        place = _place(world, step.object)
        facts: dict[str, Any] = {"position_m": np.round(place, 4).tolist()}
        if step.near is not None and step.within is not None:
            away = float(np.linalg.norm(place - _place(world, step.near)))
            facts["distance_m"] = round(away, 4)
            if away > step.within:
                raise StepFailed(f"{step.object!r} is {away:.3f} m from {step.near!r}; at most {step.within:g} m asked")
        return facts

    def _image(self, camera: str, timeout_s: float) -> Steps:
        session = self._session
        begun_ns = session.clock.now_ns()
        images = session.bus.subscribe(f"/camera/{camera}/image_raw", 1)
        try:
            while session.clock.now_ns() - begun_ns < ns(timeout_s):
                received = images.get()
                message = received.message if received is not None else None
                if isinstance(message, Image | CompressedImage) and message.header.stamp_ns >= begun_ns:
                    return {"topic": images.topic, "stamp_ns": message.header.stamp_ns}
                yield from self._tick()
        finally:
            images.close()
        raise StepFailed(f"no image of camera {camera!r} within {timeout_s:g} s")

    def _record(self, step: RecordStep) -> Steps:
        if step.of == "policy":
            self._episode = step
            return {}
        self._enter(self.checked.mode.name)
        begun_ns = self._session.clock.now_ns()
        while not self._begin_episode(step, late=self._session.clock.now_ns() - begun_ns > _ALIVE_NS):
            yield from self._tick()
        self._recording = True
        return {}

    def _begin_episode(self, episode: RecordStep, *, late: bool) -> bool:
        """Begin an episode, unless topics of the contract are still silent; when `late`, that is an error."""
        try:
            self._session.bus.call(BEGIN_EPISODE, episode.prompt)
        except IbrobotError:
            if late:
                raise
            return False
        return True

    def _end_recording(self, outcome: str) -> None:
        """End the episode of the task, if one is recorded."""
        recorded, self._recording = self._recording, False
        if recorded and self._session.bus.serves(END_EPISODE):
            self._session.bus.call(END_EPISODE, outcome)


def _code(error: Exception) -> str:
    """MoveIt's name of an error, or empty."""
    if isinstance(error, StepFailed):
        return error.code
    return error.code.name if isinstance(error, PlanningError) else ""


def _place(world: World, name: str) -> Vector:
    position = object_pose(world, name).position
    return np.array([position.x, position.y, position.z])


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

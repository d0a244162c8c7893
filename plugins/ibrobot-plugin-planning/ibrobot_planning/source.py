"""Planning: goals, named or joint by joint, become trajectories for the executors of a planning mode."""

from __future__ import annotations

import itertools
import math
import queue
from collections.abc import Mapping
from typing import Any, override

import attrs
import numpy as np

from ibrobot_core.api import (
    ControlMode,
    HardwareError,
    JointGoal,
    Planner,
    PlanningError,
    PlanRequest,
    Robot,
    Session,
    SourceWorker,
    trajectory_goal,
)

GO_TO = "/planning/go_to"


@attrs.define
class _Motion:
    """A goal under way: what each executor still has to say."""

    number: int
    text: str
    waiting: set[str]
    failures: list[str] = attrs.field(factory=list)


class PlannerSource(SourceWorker):
    """Plans from where the robot is to each goal in turn; service `/planning/go_to` takes goals too.

    The goals of the request count for the mode in which the run begins.

    Raises:
        PlanningError: for a goal of the request that names no pose or joint of this robot.
    """

    def __init__(self, session: Session, mode: ControlMode) -> None:
        assert mode.planner is not None
        super().__init__(session, mode, f"planner {mode.planner.type}")
        self._component = mode.planner
        self._goals: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._events: queue.SimpleQueue[Mapping[str, Any]] = queue.SimpleQueue()
        self._motion: _Motion | None = None
        self._numbers = itertools.count(1)
        asked = () if session.has_control else session.request.goals
        self._asked = len(asked)
        self._done = 0
        for goal in asked:
            try:
                parse_goal(goal, session.config.robot)
            except PlanningError as error:
                error.exit_code = 2
                raise
            self._goals.put(goal)

    @override
    def setup(self) -> None:
        self._planner: Planner = self.session.make("planner", self._component, self._component.type)
        self.on_end.callback(self._planner.close)
        self._planner.load()

    def go_to(self, goal: str) -> None:
        """Queue a goal: a pose's name, or `joint=radians,joint=radians`.

        Raises:
            PlanningError: for one that names no pose or joint of this robot.
        """
        parse_goal(goal, self.session.config.robot)
        self._goals.put(goal)

    @override
    def begin_mode(self, seed: int) -> None:
        if self._motion is not None:
            self._finish(self._motion.text, ["control was reset"])
        self.session.bus.serve(GO_TO, self.go_to)

    @override
    def end_mode(self) -> None:
        self.session.bus.unserve(GO_TO)

    @override
    def take_goal(self, event: Mapping[str, Any]) -> None:
        self._events.put(event)

    @override
    def work(self, timeout_s: float) -> None:
        try:
            event = self._events.get(timeout_s > 0, timeout_s or None)
        except queue.Empty:
            event = None
        with self.lock:
            if event is not None:
                self._advance(event)
            if self.active and self._motion is None and not self._goals.empty():
                self._begin(self._goals.get())

    def _begin(self, text: str) -> None:
        session, number = self.session, next(self._numbers)
        try:
            goals = self._plan(text)
        except PlanningError as error:
            self._finish(text, [str(error)])
            return
        self._motion = _Motion(number, text, set(goals))
        try:
            for executor, goal in goals.items():
                session.control.call("goal", executor=executor, goal_id=f"{number}:{executor}", goal=goal)
        except HardwareError as error:
            session.control.call("cancel")  # those that took their goal already
            self._finish(text, [str(error)])

    def _plan(self, text: str) -> dict[str, Mapping[str, Any]]:
        """Executor -> its goal."""
        session = self.session
        robot, measured = session.config.robot, session.measured()
        goal = parse_goal(text, robot)
        # From the commanded positions, not from where the joints sag to: the setpoint makes no step.
        told = session.state.command if session.state is not None else measured.position
        goals: dict[str, Mapping[str, Any]] = {}
        for name in self.mode.executors:
            executor = session.config.executors[name]
            mine = [joint for joint in executor.joints if joint in goal]
            if not mine:
                continue
            if executor.goals == "position":
                goals[name] = {"position": goal[mine[0]]}
                continue
            request = PlanRequest(
                executor.joints,
                told[robot.indices(executor.joints)],
                JointGoal(tuple(mine), np.array([goal[joint] for joint in mine])),
                others=dict(zip(robot.joint_names, told.tolist(), strict=True)),
            )
            goals[name] = trajectory_goal(self._planner.plan(request).trajectory)
        if not goals:
            raise PlanningError(f"goal {text!r}: no executor of mode {self.mode.name} has these joints")
        return goals

    def _advance(self, event: Mapping[str, Any]) -> None:
        motion = self._motion
        if motion is None or event["state"] == "executing" or event["goal"] != f"{motion.number}:{event['executor']}":
            return
        motion.waiting.discard(str(event["executor"]))
        if event["state"] != "succeeded":
            motion.failures.append(f"{event['executor']} {event['state']}: {event['message']}")
        if not motion.waiting:
            self._finish(motion.text, motion.failures)

    def _finish(self, text: str, failures: list[str]) -> None:
        self._motion = None
        self._done += 1
        if failures:
            self.session.outcome.goals_failed += 1
            self.session.log.error("goal %s failed: %s", text, "; ".join(failures))
        else:
            self.session.log.info("goal %s reached", text)
        if self._asked and self._done >= self._asked:
            self.session.finish()


def parse_goal(text: str, robot: Robot) -> dict[str, float]:
    """Joint -> position [rad] of a goal: a pose's name, or `joint=radians,joint=radians`.

    Raises:
        PlanningError: for one that names no pose or joint of this robot.
    """
    if "=" not in text:
        try:
            return dict(zip(robot.joint_names, robot.pose(text).tolist(), strict=True))
        except KeyError as error:
            raise PlanningError(f"goal {text!r}: {error.args[0]}; or give joints, e.g. wrist_flex=0.5") from None
    goal = {}
    for part in text.split(","):
        joint, _, value = (piece.strip() for piece in part.partition("="))
        if joint not in robot.joint_names:
            raise PlanningError(f"goal {text!r}: no joint {joint!r}; the joints are: {', '.join(robot.joint_names)}")
        try:
            goal[joint] = float(value)
        except ValueError:
            goal[joint] = math.nan
        if not math.isfinite(goal[joint]):
            raise PlanningError(f"goal {text!r}: {value!r} is not an angle in radians") from None
    return goal

"""Execution of planned motions by the executors of a mode: begin, blend, stop."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Any

import attrs
import numpy as np

from ibrobot_core.api import (
    ExecutorGoal,
    FollowTrajectory,
    HardwareError,
    Header,
    JointTrajectory,
    JointTrajectoryPoint,
    PlanningError,
    SlowDown,
    Vector,
    ns,
    seconds,
)
from ibrobot_core.app import GoalRun, RunView
from ibrobot_planning.execution.door import GoalDoor, Track
from ibrobot_planning.planners.blend import Limits, braking, cut, joined
from ibrobot_planning.planners.timing import Motion, motion_of, trajectory_of

_LATENCY_S = 0.04
"""How far ahead a trajectory takes over from the running one, so that its goal arrives in time."""
_LEAD_S = 0.15
"""How long a replaced motion goes on before it brakes, so that quick replans do not slow the arm."""


def commanded(session: RunView) -> Vector:
    """Commanded positions [rad], shape (J,): unlike measured ones, they do not sag."""
    return session.state.command if session.state is not None else session.measured().position


@attrs.define(eq=False)
class _Next:
    """A goal that waits for the braking motion."""

    goal: ExecutorGoal
    motion: Motion | None
    """The goal as a motion, if it is one."""
    refused: str = ""
    """Why the executor last refused it; often because it came too late."""


class Execution:
    """The goals that executors follow. Methods may be called from several threads.

    Args:
        session: the run.
        door: through which its goals pass, and which checks motions for collisions.
    """

    def __init__(self, session: GoalRun, door: GoalDoor) -> None:
        self._session = session
        self._door = door
        self._lock = threading.RLock()
        self._tracks: dict[str, Track] = {}
        """Executor -> the goal that it follows."""
        self._ahead: dict[str, _Next] = {}
        """Executor -> the goal that waits for its braking motion."""
        self._number = 0
        self._stops = 0
        """Number of emergency stops when the present move was requested."""

    @property
    def under_way(self) -> bool:
        """Whether an executor follows a goal."""
        return bool(self._tracks or self._ahead)

    def follows(self, goal_id: str) -> bool:
        """Whether a goal is one of these."""
        with self._lock:
            return any(track.goal_id == goal_id for track in self._tracks.values())

    def begin(self, number: int, goals: Mapping[str, ExecutorGoal], stops: int) -> None:
        """Send goals to executors at rest.

        Args:
            number: of the move.
            goals: executor -> its goal.
            stops: number of emergency stops when it was requested; control refuses it after a newer one.

        Raises:
            HardwareError: if an executor refuses its goal; those that were sent before are cancelled.
            PlanningError: the same, if a trajectory fails a check.
        """
        with self._lock:
            self._tracks, self._ahead, self._number, self._stops = {}, {}, number, stops
            try:
                for name, goal in goals.items():
                    self._send(name, f"{number}:{name}", goal)
            except (HardwareError, PlanningError):
                for name in self._tracks:
                    self._session.cancel_goals(name)
                self._tracks = {}
                raise

    def stop(self, number: int) -> None:
        """Let all executors slow down and hold."""
        session = self._session
        with self._lock:
            self._ahead.clear()
            for name in sorted(self._tracks):
                goal_id = f"{number}:stop:{name}"
                try:
                    session.send_goal(name, goal_id, SlowDown())
                except HardwareError as error:
                    session.log.warning("%s does not slow down, and is cancelled: %s", name, error)
                    session.cancel_goals()
                    return
                self._tracks[name] = Track(goal_id, None)

    def brake(self, number: int, stops: int) -> Vector | None:
        """Brake along the path after a moment, unless `follow` adds the next motion before.

        Args:
            number: of the next move.
            stops: as for `begin`.

        Returns:
            Where the robot comes to rest [rad], shape (J,); None if a running goal cannot brake.
        """
        with self._lock:
            braked = self._braked()
            if braked is None:
                return None
            rest = commanded(self._session).copy()
            try:
                for name, (begin_ns, way) in braked.items():
                    self._door.free(way)  # along the path under way
                    goal = FollowTrajectory(way, takes_over=self._tracks[name].goal_id, at_ns=begin_ns)
                    self._send(name, f"{number}:brake:{name}", goal)
                    rest[self._session.config.robot.indices(way.joint_names)] = way.points[-1].positions
            except (HardwareError, PlanningError) as error:
                self._session.log.warning("the arm stops before its next motion: braking was refused: %s", error)
                return None
            self._number, self._stops = number, stops
            return rest

    def check(self, goals: Mapping[str, ExecutorGoal]) -> None:
        """Check goals against the present world, as when they are sent to executors at rest.

        Raises:
            PlanningError: if one is not free.
        """
        for goal in goals.values():
            if isinstance(goal, FollowTrajectory):
                self._door.check_free(goal.trajectory)

    def follow(self, goals: Mapping[str, ExecutorGoal], *, blends: bool) -> None:
        """Add the next motion to the braking one.

        Args:
            goals: executor -> its goal.
            blends: whether it may begin before the arm rests: a blend leaves the path, and path constraints with it.
        """
        with self._lock:
            self._ahead = {
                name: _Next(goal, motion_of(goal.trajectory) if blends and isinstance(goal, FollowTrajectory) else None)
                for name, goal in goals.items()
            }
        self.step()

    def step(self) -> None:
        """Send goals of `follow` whose time has come."""
        with self._lock:
            for name, following in list(self._ahead.items()):
                track, goal = self._tracks.get(name), following.goal
                if not isinstance(goal, FollowTrajectory) or track is None or track.trajectory is None:
                    sent = self._begin(name, following)
                else:
                    sent = self._blended(name, track, track.trajectory, following, goal.trajectory)
                if sent:
                    self._ahead.pop(name, None)

    def take(self, event: Mapping[str, Any]) -> str | None:
        """Process an event of an executor.

        Returns:
            None if the event did not end its goal; otherwise what went wrong, or an empty text.
        """
        name, state = str(event["executor"]), str(event["state"])
        with self._lock:
            track = self._tracks.get(name)
            if track is None or track.goal_id != event["goal"]:
                return None
            if state == "executing":
                return None
            del self._tracks[name]
        return "" if state == "succeeded" else f"{name} {state}: {event['message']}"

    def touched(self) -> str:
        """What the arm touches or is too near to at present; empty if nothing."""
        session, position = self._session, commanded(self._session)
        robot = session.config.robot
        for name in session.config.control_modes[session.mode].executors:
            executor = session.config.executors[name]
            if executor.goals == "trajectory":
                here, rest = position[robot.indices(executor.joints)], np.zeros(len(executor.joints))
                points = tuple(JointTrajectoryPoint(stamp, here, rest, rest) for stamp in (0, ns(0.01)))
                if touched := self._door.blocked(JointTrajectory(Header(), executor.joints, points)):
                    return touched
        return ""

    def _send(self, name: str, goal_id: str, goal: ExecutorGoal) -> None:
        if isinstance(goal, FollowTrajectory):
            self._door.complete(goal.trajectory)
        self._session.send_goal(name, goal_id, goal, self._stops)
        self._tracks[name] = self._door.track(name, goal_id)

    def _begin(self, name: str, following: _Next) -> bool:
        """Send a goal to an executor at rest; True, as it needs no retry."""
        if following.refused:
            self._session.log.warning("the next motion of %s began after a stop: %s", name, following.refused)
        self._send(name, f"{self._number}:{name}", following.goal)
        return True

    def _take_over(self, name: str, following: _Next, goal: FollowTrajectory) -> bool:
        """Let a trajectory take over from the running one; False if the executor refuses it, e.g. as too late."""
        try:
            self._send(name, f"{self._number}:{name}", goal)
        except (HardwareError, PlanningError) as error:
            following.refused = str(error)
            return False
        return True

    def _braked(self) -> dict[str, tuple[int, JointTrajectory]] | None:
        """Executor -> when its braking motion takes over [ns], and that motion; None if one cannot brake."""
        robot, state = self._session.config.robot, self._session.state
        braked = {}
        for name, track in self._tracks.items():
            if track.trajectory is None and self._session.config.executors[name].goals == "position":
                continue
            old = track.motion
            if old is None or track.begin_ns is None or state is None or track.trajectory is None:
                return None
            begin_s = round(seconds(state.stamp_ns - track.begin_ns) + _LATENCY_S, 3)
            if begin_s >= old.duration:
                return None
            joints = track.trajectory.joint_names
            way = braking(old, begin_s, begin_s + _LEAD_S, robot.max_acceleration[robot.indices(joints)])
            braked[name] = ns(begin_s), trajectory_of(way, joints, self._session.clock.now_ns())
        return braked or None

    def _blended(
        self, name: str, track: Track, running: JointTrajectory, following: _Next, goal: JointTrajectory
    ) -> bool:
        """Begin a motion while the executor brakes; False if its time has not come."""
        state, old, new = self._session.state, track.motion, following.motion
        if track.begin_ns is None or state is None or old is None:
            return False
        passed_s = seconds(state.stamp_ns - track.begin_ns)
        if passed_s > old.duration:
            return self._begin(name, following)
        begin_s = round(passed_s + _LATENCY_S, 3)
        if new is None or begin_s >= old.duration:
            return False
        robot = self._session.config.robot
        order = robot.indices(running.joint_names)
        limits = Limits(
            robot.lower[order], robot.upper[order], robot.max_velocity[order], robot.max_acceleration[order]
        )
        for way in joined(old, new, begin_s, limits):
            # Only the overlap needs a check: the planner has checked the rest of the new motion.
            overlap = trajectory_of(cut(way, old.duration - begin_s), running.joint_names, goal.header.stamp_ns)
            if not self._door.blocked(overlap):
                blend = trajectory_of(way, running.joint_names, goal.header.stamp_ns)
                self._door.free(blend)
                goal_there = FollowTrajectory(blend, takes_over=track.goal_id, at_ns=ns(begin_s))
                return self._take_over(name, following, goal_there)
        return False

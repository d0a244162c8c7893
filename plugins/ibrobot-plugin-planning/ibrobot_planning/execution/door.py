"""The door of all goals, of any client: trajectories are completed, checked, and watched while they move."""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any, override
from weakref import WeakKeyDictionary

import attrs
import numpy as np

from ibrobot_core.api import (
    ExecutorGoal,
    FollowTrajectory,
    GoalRejected,
    HardwareError,
    IbrobotError,
    JointTrajectory,
    MoveJoint,
    PlanCode,
    PlanningError,
    SlowDown,
    ns,
    seconds,
)
from ibrobot_core.app import ControlState, GuardedRun, RunView, SessionWorker
from ibrobot_planning.planner import Planner
from ibrobot_planning.planners.completion import Start, check_size, completed
from ibrobot_planning.planners.options import GoalCheckOptions, RrtConnectOptions
from ibrobot_planning.planners.timing import CHECK_S, Motion, motion_of
from ibrobot_planning.world.engines import find_engines
from ibrobot_planning.world.objects import World, with_floor, world_of

WORLD = "world"
"""The section whose objects are the world."""
_AHEAD_S = (0.05, 0.15, 0.4)
"""How far ahead a trajectory takes over from the running one, at each attempt; its check takes a part of the time."""
_STRIDE = 2
"""Every second one of the planner's checks is repeated in the present world."""
_PART_S = 5.0
"""Part of a long motion that is checked at a time: a change of the world is looked for in between [s]."""
_WATCH_S = 0.02
"""Interval at which motions are checked against the present world [s]."""
_GRANTED_S = 0.01
"""Interval at which a path is compared with what is granted to an agent [s]."""
_FAR_RAD = 100.0
"""Positions beyond which no joint can be [rad], as none is at NaN."""
_GRANTED_RAD = 0.02
"""Interval at which the way of a single joint is compared with it [rad]."""
_STILL_RAD = 1e-4
"""Commands that change less in a tick count as at rest."""
_GLANCE_S = 0.1
_REST_S = 1.0
"""Longest wait for joints that come to rest, e.g. after a cancel [s]."""

type Send = Callable[[ExecutorGoal], None]


@attrs.define(eq=False)
class Track:
    """A goal that an executor follows."""

    goal_id: str
    trajectory: JointTrajectory | None
    """None while it slows down."""
    begin_ns: int | None = None
    """When it began [ns]; None until the executor reports it."""

    @cached_property
    def motion(self) -> Motion | None:
        """The trajectory as a motion, if it is one."""
        return None if self.trajectory is None else motion_of(self.trajectory)


class GoalDoor(SessionWorker):
    """Completes and checks each trajectory before control gets it, and stops it if the world comes into its way.

    A trajectory for joints that follow another one takes over from it without a step: it is completed and checked from
    where the joints will be then. Goals of positions, as of grippers, are checked by their executors.
    """

    session: GuardedRun

    def __init__(self, options: GoalCheckOptions, session: GuardedRun) -> None:
        super().__init__(session, "goals", "checks goals before control gets them")
        self._options = options
        self._robot = session.config.robot
        self._executors = [name for name, each in session.config.executors.items() if each.goals == "trajectory"]
        self._period_ns = ns(1.0 / session.config.control.rate_hz)
        self._unchecked: str | None = None
        """Why trajectories are not checked against the world; empty if they are, None before the model is loaded."""
        self._loading = threading.Lock()
        self._complete: deque[JointTrajectory] = deque(maxlen=16)
        """Trajectories that a planner's source has completed from where the robot is."""
        self._free: deque[tuple[JointTrajectory, World]] = deque(maxlen=16)
        """Trajectories, each with the world in which it is free, or all of it that is still new."""
        self._door = threading.Lock()
        """Held while a goal passes."""
        self._tracks: dict[str, Track] = {}
        """Executor -> the goal that it follows."""
        self._begun = threading.Condition()
        """Notified when goals begin or end."""
        self._seen: ControlState | None = None
        """The newest state that `_moved_ns` knows of."""
        self._moved_ns = np.full(len(self._robot.joints), -ns(1e6), dtype=np.int64)
        """When the command of each joint last changed [ns], shape (J,); long ago if it has not."""
        self.planner: Planner | None = None
        """The planner of the mode, which may know more of the world than the run."""
        self.stops_before: Callable[[str, str, PlanCode], bool] = lambda goal_id, touched, code: False
        """Called with a goal, what has come into its way, and MoveIt's code; returns whether its sender stops it."""
        _DOORS[session] = self

    @override
    def setup(self) -> None:
        session = self.session
        if self._robot.description.mjcf is None:
            self._go_unchecked("robot.description.mjcf is missing")
        elif WORLD not in session.config.plugin_sections:
            names = ", ".join(self._executors)
            session.log.info("goals of %s are checked against the arm itself; a section world adds objects", names)
        active = set(session.config.control_modes[session.mode].executors)
        if active.intersection(self._executors) and not session.request.lockstep:
            # It takes seconds: not while the first goal waits.
            threading.Thread(target=self._is_checked, name=f"{self.name} model", daemon=True).start()
        session.on_state.append(self._take_state)
        session.on_goal.append(self._take_event)
        session.goal_door = self.take
        self.on_end.callback(session.on_state.remove, self._take_state)
        self.on_end.callback(session.on_goal.remove, self._take_event)

    def _go_unchecked(self, why: str) -> None:
        """Let trajectories pass that are within the limits, and say so."""
        self._unchecked = why
        names = ", ".join(self._executors)
        self.session.log.warning("goals of %s are limited, not checked against the world: %s", names, why)

    def _is_checked(self) -> bool:
        """Whether trajectories are checked against the world; the first call loads the arm's model."""
        with self._loading:
            if self._unchecked is None:
                try:
                    find_engines()
                    _ = self._arm
                except IbrobotError as error:
                    self._go_unchecked(str(error))
                else:
                    self._unchecked = ""
            return not self._unchecked

    @property
    def _arm(self) -> Any:
        from ibrobot_planning.world.checked_arm import checked_arm

        return checked_arm(self._robot, self.session.log)

    @override
    def work(self, timeout_s: float) -> None:
        if timeout_s:
            self.pause(min(timeout_s, _WATCH_S))
        for name, track in list(self._tracks.items()):
            if track.trajectory is not None:
                self._watch(name, track, track.trajectory)

    def blocked(self, trajectory: JointTrajectory, from_ns: int = 0) -> str:
        """What a trajectory touches in the present world, in words; empty if nothing, or if no world is known.

        Args:
            trajectory: with velocities and accelerations; other joints are where they are commanded.
            from_ns: where it begins [ns]; what lies before is past.

        Raises:
            PlanningError: if the world cannot be trusted, e.g. because a cloud is too old.
        """
        others = self._others()
        touched = self._touched(trajectory, others, from_ns) if self._is_checked() else ""
        if touched or self.planner is None:
            return touched
        return self.planner.blocked(trajectory, others, from_ns)

    def _touched(self, trajectory: JointTrajectory, others: Mapping[str, float], from_ns: int) -> str:
        """What a trajectory touches in the world of the run, as `blocked`."""
        from ibrobot_planning.world.collision import Collisions, outwards, sentence

        world, margins = self._world(), self._margins()
        if any(known is trajectory and in_world == world for known, in_world in tuple(self._free)):
            return ""
        made = motion_of(trajectory)
        if made is None:
            return "a trajectory without velocities and accelerations cannot be checked"
        paddings = {"padding": margins.padding, "self_padding": margins.self_padding}
        checks = Collisions(self._arm, world, trajectory.joint_names, others, **paddings)
        begin = begun = min(round(seconds(from_ns) / CHECK_S) * CHECK_S, made.duration)
        while True:
            positions = made.sampled(_STRIDE * CHECK_S, begin, begin + _PART_S)[0]
            leaving = 0
            if begin == begun:  # contacts at the start may open
                leaving = outwards(checks, positions) or 0
            hit = leaving + checks.first_hit_on_path(positions[leaving:])
            if hit < len(positions):
                return sentence(checks.contacts(positions[hit]))
            begin += _PART_S
            if begin >= made.duration:
                self._free.append((trajectory, world))
                return ""
            if from_ns and self._world() != world:
                return ""  # it is under way: the next check, which follows at once, begins with what comes first

    def check_free(self, trajectory: JointTrajectory) -> None:
        """Check a trajectory against the present world.

        Raises:
            PlanningError: if it is not free.
        """
        if touched := self.blocked(trajectory):
            raise PlanningError(f"the trajectory is not free: {touched}", PlanCode.INVALID_MOTION_PLAN)

    def track(self, executor: str, goal_id: str) -> Track:
        """The track of a goal that was just sent to an executor; without a trajectory if it follows none."""
        track = self._tracks.get(executor)
        return track if track is not None and track.goal_id == goal_id else Track(goal_id, None)

    @property
    def at_rest(self) -> bool:
        """Whether the commands of all joints are at rest: the safety layer may follow the executors with a delay."""
        return self._rests(slice(None))

    def complete(self, trajectory: JointTrajectory) -> None:
        """Take note that a trajectory was completed from where the robot is, and is within the limits."""
        self._complete.append(trajectory)

    def free(self, trajectory: JointTrajectory) -> None:
        """Take note that a trajectory that takes over from the running one is free and within the limits."""
        if self._is_checked():
            self._free.append((trajectory, self._world()))

    def take(self, executor: str, goal_id: str, goal: ExecutorGoal, send: Send) -> None:
        """Let a goal pass. See `Session.goal_door`.

        Raises:
            PlanningError: if it fails a check.
            IbrobotError: if control refuses it.
        """
        if not isinstance(goal, FollowTrajectory) or executor not in self._executors:
            if isinstance(goal, SlowDown):
                self._tracks.pop(executor, None)  # it slows down: who sends this watches it
            elif isinstance(goal, MoveJoint):
                self._check_joint_granted(executor, goal.position)
            send(goal)
            return
        if executor not in self.session.config.control_modes[self.session.mode].executors:
            raise GoalRejected(f"executor {executor!r} is not active in mode {self.session.mode}")
        with self._door:
            if goal.takes_over is not None or any(known is goal.trajectory for known in self._complete):
                self.check_free(goal.trajectory)
                self._send(executor, goal_id, goal, send)
            else:
                self._complete_and_send(executor, goal_id, goal, send)

    def _complete_and_send(self, executor: str, goal_id: str, goal: FollowTrajectory, send: Send) -> None:
        trajectory = goal.trajectory
        check_size(trajectory)
        unknown = [name for name in trajectory.joint_names if name not in self._robot.joint_names]
        if unknown or not trajectory.joint_names:
            raise PlanningError(f"no joints {unknown}", PlanCode.INVALID_GROUP_NAME)
        for ahead_s in _AHEAD_S:
            start, takes_over = self._start(executor, trajectory.joint_names, ahead_s)
            whole = completed(trajectory, start, self._robot, self._period_ns)
            self.check_free(whole)
            try:
                self._send(executor, goal_id, attrs.evolve(goal, trajectory=whole, **takes_over), send)
            except HardwareError as error:
                if not takes_over:
                    raise
                refused = error  # e.g. too late: the running goal has gone on, or ended
            else:
                return
        raise refused

    def _start(self, executor: str, joints: tuple[str, ...], ahead_s: float) -> tuple[Start, dict[str, Any]]:
        """Where a trajectory begins, and what it takes over from: the running one, if there is one."""
        session, order = self.session, self._robot.indices(joints)
        track = self._tracks.get(executor)
        if track is not None and track.begin_ns is None and not session.request.lockstep:
            with self._begun:
                self._begun.wait_for(lambda: track.begin_ns is not None, _GLANCE_S)
        state = session.state
        motion = track.motion if track is not None else None
        if state is None or track is None or motion is None or track.begin_ns is None or track.trajectory is None:
            return self._at_rest(order), {}
        passed_s = seconds(state.stamp_ns - track.begin_ns)
        if passed_s >= motion.duration:
            return self._at_rest(order), {}
        begin_s = min(round(passed_s + ahead_s, 3), motion.duration)
        columns = [track.trajectory.joint_names.index(name) for name in joints]
        position, velocity, acceleration = motion.at(begin_s)[:, columns]
        takes_over = {"takes_over": track.goal_id, "at_ns": ns(begin_s)}
        if begin_s == motion.duration:
            return Start(position), takes_over
        return Start(position, velocity, acceleration), takes_over

    def _at_rest(self, order: Any) -> Start:
        """Where joints are that no goal moves, once they are at rest.

        Raises:
            PlanningError: if they are not.
        """
        session = self.session
        states = session.watch_states()
        ticks = 1 if session.request.lockstep else round(ns(_REST_S) / self._period_ns)
        for _ in range(ticks):
            measured, state = session.measured().position, session.state
            assert state is not None
            if self._rests(order):
                return Start(state.command[order], measured=measured[order])
            if session.request.lockstep or states.get(_GLANCE_S) is None:
                break
        raise PlanningError("the joints still move: wait until they are at rest", PlanCode.START_STATE_INVALID)

    def _rests(self, order: Any) -> bool:
        """Whether the commands of some joints have not changed for two ticks."""
        seen = self._seen
        return seen is not None and bool(seen.stamp_ns >= self._moved_ns[order].max() + 2 * self._period_ns)

    def _world(self) -> World:
        """The present world, with the floor."""
        floor = self._margins().floor
        return with_floor(world_of(self.session.bus), self._robot.description.floor if floor is None else floor)

    def _margins(self) -> GoalCheckOptions:
        """Distances of the mode's planner, or of the section."""
        planner = self.session.config.control_modes[self.session.mode].planner
        if planner is not None and isinstance(planner.options, RrtConnectOptions):
            return planner.options
        return self._options

    def _others(self) -> dict[str, float]:
        """Joint -> its commanded position [rad]."""
        state = self.session.state
        command = state.command if state is not None else self.session.measured().position
        return dict(zip(self._robot.joint_names, command.tolist(), strict=True))

    def _check_granted(self, trajectory: JointTrajectory) -> None:
        """Check a trajectory against what is granted to an agent, if anything is.

        Raises:
            HardwareError: if it goes beyond that.
        """
        authority, robot = self.session.authority, self._robot
        if authority.grant is None:
            return
        if (motion := motion_of(trajectory)) is None:  # nobody has completed it
            authority.check_path(np.empty((0, len(robot.joints))), math.inf)
            return
        columns = robot.indices(trajectory.joint_names)
        positions, velocities, _ = motion.sampled(_GRANTED_S)
        whole = np.tile([self._others()[name] for name in robot.joint_names], (len(positions), 1))
        whole[:, columns] = positions
        authority.check_path(whole, float((np.abs(velocities) / robot.max_velocity[columns]).max()))

    def _check_joint_granted(self, executor: str, position: float) -> None:
        """Check the way of a joint to a position [rad] against what is granted to an agent, if anything is.

        Raises:
            HardwareError: if it goes beyond that.
        """
        if self.session.authority.grant is None:
            return
        robot, others = self._robot, self._others()
        here = np.array([others[name] for name in robot.joint_names])
        there = here.copy()
        there[robot.indices(self.session.config.executors[executor].joints)] = position
        if not (np.abs(there) < _FAR_RAD).all():
            return  # the executor refuses it
        steps = 2 + int(np.abs(there - here).max() / _GRANTED_RAD)
        self.session.authority.check_path(np.linspace(here, there, steps), 0.0)

    def _send(self, executor: str, goal_id: str, goal: FollowTrajectory, send: Send) -> None:
        self._check_granted(goal.trajectory)
        before, track = self._tracks.get(executor), Track(goal_id, goal.trajectory)
        self._tracks[executor] = track
        try:
            send(goal)
        except BaseException:
            if self._tracks.get(executor) is track:
                self._tracks.pop(executor)
                if before is not None:
                    self._tracks[executor] = before
            raise

    def _watch(self, name: str, track: Track, trajectory: JointTrajectory) -> None:
        """Have a motion stop that the present world blocks."""
        state, code = self.session.state, PlanCode.MOTION_PLAN_INVALIDATED_BY_ENVIRONMENT_CHANGE
        if state is None:
            return
        passed_ns = 0 if track.begin_ns is None else max(0, state.stamp_ns - track.begin_ns)
        try:
            touched = self.blocked(trajectory, passed_ns)
        except PlanningError as error:
            touched = f"the motion cannot be checked: {error}"
            if error.code is PlanCode.SENSOR_INFO_STALE:
                code = error.code
        if not touched or self._tracks.get(name) is not track:
            return
        if self.stops_before(track.goal_id, touched, code) or self._tracks.get(name) is not track:
            return
        self.session.log.warning("%s stops before an obstacle: %s", name, touched)
        track.trajectory = None
        try:
            self.session.send_goal(name, f"{track.goal_id} before {touched}", SlowDown())
        except HardwareError:  # an executor of another plugin may not know how to slow down
            self.session.cancel_goals(name)

    def _take_event(self, event: Mapping[str, Any]) -> None:
        with self._begun:
            track = self._tracks.get(event["executor"])
            if track is not None and track.goal_id == event["goal"]:
                if event["state"] == "executing":
                    track.begin_ns = event["result"].get("begin_ns")
                else:
                    self._tracks.pop(event["executor"], None)
            self._begun.notify_all()

    def _take_state(self, state: ControlState) -> None:
        if self._seen is not None:
            self._moved_ns[np.abs(state.command - self._seen.command) > _STILL_RAD] = state.stamp_ns
        self._seen = state


_DOORS: WeakKeyDictionary[RunView, GoalDoor] = WeakKeyDictionary()


def door_of(session: RunView) -> GoalDoor:
    """The door of a run."""
    return _DOORS[session]

"""Goals of ROS's actions for the executors of a run, as ros2_control's controllers take them, and for its services.

What speaks to clients (a node of rclpy's, or Zenoh) passes goals as plain mappings of ROS's fields, and gets heads:
plain mappings whose key `op` says what they are. The key `values` of a head has the fields of feedback or of a result.
"""

from __future__ import annotations

import math
import threading
from collections import Counter
from collections.abc import Callable, Collection, Mapping
from enum import IntEnum
from typing import Any

import attrs
import numpy as np

from ibrobot_core.api import (
    NS_PER_S,
    ExecutorGoal,
    FollowTrajectory,
    GoalRejected,
    Header,
    IbrobotError,
    JointReading,
    JointTrajectory,
    JointTrajectoryPoint,
    MoveJoint,
    PlanCode,
    PlanningError,
    seconds,
)
from ibrobot_core.app import ControlState, ExecutorConfig, GoalRun
from ibrobot_ros2.calls import Calls, GoalRequest, Wire
from ibrobot_ros2.inference import serve_chunks
from ibrobot_ros2.offers import time_of, with_ns

GRIPPER_ACTIONS = ("GripperCommand", "ParallelGripperCommand")
"""Actions of control_msgs for executors that take a position."""
FEEDBACK_NS = NS_PER_S // 20
"""Interval of feedback, as of joint_trajectory_controller [ns]."""


class TrajectoryCode(IntEnum):
    """Error codes of control_msgs/action/FollowJointTrajectory."""

    SUCCESSFUL = 0
    INVALID_GOAL = -1
    INVALID_JOINTS = -2
    OLD_HEADER_TIMESTAMP = -3
    PATH_TOLERANCE_VIOLATED = -4
    GOAL_TOLERANCE_VIOLATED = -5


_EXCEEDED = {"path": TrajectoryCode.PATH_TOLERANCE_VIOLATED, "goal": TrajectoryCode.GOAL_TOLERANCE_VIOLATED}


class _Invalid(GoalRejected):
    """A goal that is refused, with its code."""

    def __init__(self, message: str, code: TrajectoryCode = TrajectoryCode.INVALID_GOAL) -> None:
        super().__init__(message)
        self.code = code


@attrs.define(eq=False)
class _Goal:
    """A goal of ROS that an executor has."""

    number: int
    executor: str
    begun_ns: int
    fed_ns: int
    canceled: bool = False
    """Whether its client canceled it."""


def action_of(executor: ExecutorConfig, gripper_action: str) -> tuple[str, str]:
    """The name of an executor's action, and its type."""
    if executor.goals == "trajectory":
        return f"/{executor.name}/follow_joint_trajectory", "control_msgs/action/FollowJointTrajectory"
    return f"/{executor.name}/gripper_cmd", f"control_msgs/action/{gripper_action}"


def with_goals(session: GoalRun) -> dict[str, ExecutorConfig]:
    """The executors of a run that take goals, by name."""
    return {name: executor for name, executor in session.config.executors.items() if executor.goals}


class Actions:
    """Passes goals and cancels of ROS to the run, and what becomes of them back.

    Args:
        session: the run.
        executors: names of those that are offered.
        is_offered: whether a service of the bus is offered; those that take their time are actions.
        named: the full name of an action, from that without namespace.
        who: where goals come from, for the log and their names, e.g. `ros`.
        gripper_action: the action of executors that take a position.

    A goal replaces the one before, of any client, as on ros2_control's controllers: also one of the run's own planner,
    which then reports its motion as replaced.

    ROS 2 rejects a goal without saying why. A trajectory that is refused is therefore accepted and aborted at once, so
    that its result says why; grippers' results have no such field, and their goals are rejected (ADR 58).
    """

    def __init__(
        self, session: GoalRun, executors: Collection[str], is_offered: Callable[[str], bool],
        named: Callable[[str], str], who: str, gripper_action: str,
    ) -> None:  # fmt: skip
        self._session = session
        self._named = named
        self._who = who
        self._gripper_action = gripper_action
        self._executors = {name: each for name, each in with_goals(session).items() if name in executors}
        self._calls = Calls(session, is_offered, named, who)
        self._refused = Counter[str]()
        """Cause -> number of goals that were refused for it."""
        self._end_chunks: Callable[[], None] = lambda: None
        self._lock = threading.Lock()
        self._goals: dict[str, _Goal] = {}
        """Goals under way, by their name in control."""
        self._wire: Wire | None = None
        self._node = 0
        """Number of the node: goals of one that is gone are not those of the next."""

    def open(self) -> None:
        """Begin to follow what becomes of goals."""
        self._end_chunks = serve_chunks(self._session)
        self._session.on_goal.append(self._take_event)
        self._session.on_state.append(self._take_state)

    def close(self) -> None:
        """Wait for the calls under way, which end with the run."""
        if self._take_event in self._session.on_goal:
            self._session.on_goal.remove(self._take_event)
            self._session.on_state.remove(self._take_state)
        self._end_chunks()
        self._calls.close()

    def declare(self, wire: Wire) -> None:
        """Tell a new node which actions it offers."""
        self._wire = wire
        self._node += 1
        for executor in self._executors.values():
            name, type_name = action_of(executor, self._gripper_action)
            wire.offer(self._named(name), type_name, executor=executor.name)
        self._calls.declare(wire)

    def refresh(self, wire: Wire) -> None:
        """Tell the node which actions are new."""
        self._calls.refresh(wire)

    def take_goal(self, wire: Wire, request: GoalRequest, stops: int) -> bool:
        """Take a goal, which was received after `stops` emergency stops; returns whether it is accepted."""
        if request.service:
            return self._calls.take_goal(wire, request)
        executor = self._executors[request.executor]
        name = self._name(request.number)
        now_ns = self._session.clock.now_ns()
        with self._lock:
            self._goals[name] = _Goal(request.number, executor.name, now_ns, now_ns)
        try:
            goal = self._read(executor, with_ns(request.fields))
            self._session.send_goal(executor.name, name, goal, stops)
        except IbrobotError as error:
            with self._lock:
                self._goals.pop(name, None)
            return self.refuse(wire, request, error)
        return True

    def refuse(self, wire: Wire, request: GoalRequest, error: IbrobotError) -> bool:
        """Say why a goal is refused; returns whether it was accepted, only to say so."""
        if request.service:
            return self._calls.refuse(wire, request, error)
        executor = self._executors[request.executor]
        code = error.code if isinstance(error, _Invalid) else TrajectoryCode.INVALID_GOAL
        if isinstance(error, PlanningError) and error.code is PlanCode.INVALID_GROUP_NAME:
            code = TrajectoryCode.INVALID_JOINTS
        # Whatever follows may be a client's own words: it must not make a new cause of each goal.
        cause = error.code.name if isinstance(error, PlanningError) else f"{code.name}: {error}"[:32]
        self._refused[cause] += 1
        count = self._refused[cause]
        if math.log10(count).is_integer():  # the first, the tenth, …: a flood of them must not flood the log
            so_far = f" ({count} such goals so far)" if count > 1 else ""
            line = f"goal for {executor.name} refused: {code.name}: {error}{so_far}"
            self._session.log.warning("%s: %s", self._who, line)
        if executor.goals != "trajectory":
            return False
        values = {"error_code": int(code), "error_string": str(error)}
        wire.end(request.number, "aborted", values)
        return True

    def cancel(self, wire: Wire, number: int) -> bool:
        """Cancel a goal for its client; returns whether it is canceled."""
        with self._lock:
            goal = self._goals.get(self._name(number))
            if goal is not None:
                goal.canceled = True
        if goal is None:
            return self._calls.cancel(wire, number)
        return self._stop(goal.executor)

    def abandon(self, why: str) -> None:
        """Cancel all goals, since nobody can cancel them any more: the robot holds."""
        with self._lock:
            abandoned = {goal.executor for goal in self._goals.values()}
        for executor in abandoned:
            self._session.log.warning("%s: %s holds: %s", self._who, executor, why)
            self._stop(executor)

    def _stop(self, executor: str) -> bool:
        """Cancel the goal of an executor; returns whether that succeeded."""
        try:
            self._session.cancel_goals(executor)
        except IbrobotError as error:
            self._session.log.warning("%s: %s: cancel failed: %s", self._who, executor, error)
            return False
        return True

    def _take_event(self, event: Mapping[str, Any]) -> None:
        """Report the end of a goal."""
        if event["state"] == "executing":
            return
        with self._lock:
            goal = self._goals.pop(event["goal"], None)
        if goal is None or self._wire is None:
            return
        result, state = event["result"], event["state"]
        code = TrajectoryCode.SUCCESSFUL
        if state == "canceled" and not goal.canceled:
            state = "aborted"  # replaced, or the robot stopped: ROS knows only cancels by clients
        if state == "aborted":
            code = _EXCEEDED.get(result.get("exceeded"), TrajectoryCode.INVALID_GOAL)
        if self._executors[goal.executor].goals == "trajectory":
            values: dict[str, Any] = {"error_code": int(code), "error_string": event["message"]}
        else:
            values = self._gripper(goal.executor, self._session.measured())
            values |= {key: bool(result[key]) for key in ("stalled", "reached_goal") if key in result}
        self._wire.end(goal.number, state, values)

    def _take_state(self, state: ControlState) -> None:
        """Send feedback of the goals under way."""
        with self._lock:
            due = [goal for goal in self._goals.values() if state.stamp_ns - goal.fed_ns >= FEEDBACK_NS]
        for goal in due:
            goal.fed_ns = state.stamp_ns
            follows = self._executors[goal.executor].goals == "trajectory"
            values = self._motion(goal, state) if follows else self._gripper(goal.executor, state)
            assert self._wire is not None
            self._wire.feed(goal.number, values)

    def _motion(self, goal: _Goal, state: ControlState) -> dict[str, Any]:
        """Feedback of FollowJointTrajectory."""
        columns = self._index(goal.executor)
        desired, actual = state.command[columns], state.position[columns]
        passed = {"time_from_start": time_of(max(0, state.stamp_ns - goal.begun_ns))}
        return {
            "header": {"stamp": time_of(state.stamp_ns)},
            "joint_names": list(self._executors[goal.executor].joints),
            "desired": {"positions": desired.tolist(), **passed},
            "actual": {"positions": actual.tolist(), "velocities": state.velocity[columns].tolist(), **passed},
            "error": {"positions": (desired - actual).tolist(), **passed},
        }

    def _gripper(self, executor: str, state: ControlState | JointReading) -> dict[str, Any]:
        """Position and effort in feedback and results of the grippers' actions."""
        column = self._index(executor)[0]
        position, effort = float(state.position[column]), float(state.effort[column])
        if self._gripper_action == GRIPPER_ACTIONS[0]:
            return {"position": position, "effort": effort}
        joints = list(self._executors[executor].joints)
        return {"state": {"name": joints, "position": [position], "effort": [effort]}}

    def _name(self, number: int) -> str:
        """The name in control of a goal of the present node."""
        return f"{self._who} {self._node} {number}"

    def _index(self, executor: str) -> Any:
        return self._session.config.robot.indices(self._executors[executor].joints)

    def _read(self, executor: ExecutorConfig, goal: Mapping[str, Any]) -> ExecutorGoal:
        """The goal in the executor's form.

        Raises:
            _Invalid: if ros2_control would reject it, too.
        """
        if executor.goals == "trajectory":
            return self._trajectory(executor, goal)
        command = goal["command"]
        if self._gripper_action == GRIPPER_ACTIONS[0]:
            return MoveJoint(command["position"], command["max_effort"])
        if list(command["name"]) not in ([], list(executor.joints)):
            raise _Invalid(f"names must be {', '.join(executor.joints)}, got {', '.join(command['name'])}")
        if len(command["position"]) != 1 or len(command["effort"]) > 1:
            raise _Invalid(f"needs one position, and at most one effort, got {command['position']}")
        if command["velocity"]:
            raise _Invalid("a velocity cannot be given: the executor's option velocity is used")
        return MoveJoint(command["position"][0], (command["effort"] or [0.0])[0])

    def _trajectory(self, executor: ExecutorConfig, fields: Mapping[str, Any]) -> FollowTrajectory:
        trajectory = fields["trajectory"]
        if fields["multi_dof_trajectory"]["joint_names"]:
            raise _Invalid("multi_dof_trajectory: joints with several degrees of freedom are not supported")
        if sorted(trajectory["joint_names"]) != sorted(executor.joints):
            raise _Invalid(
                f"joint_names must be, in any order, {', '.join(executor.joints)}; got "
                f"{', '.join(trajectory['joint_names']) or 'none'}",
                TrajectoryCode.INVALID_JOINTS,
            )
        points = tuple(JointTrajectoryPoint(**point) for point in trajectory["points"])
        message = JointTrajectory(Header(**trajectory["header"]), tuple(trajectory["joint_names"]), points)
        path, goal = (_tolerances(key, fields[key]) for key in ("path_tolerance", "goal_tolerance"))
        return FollowTrajectory(self._begun(message), path, goal, seconds(fields["goal_time_tolerance_ns"]))

    def _begun(self, message: JointTrajectory) -> JointTrajectory:
        """A trajectory that begins now, of one that begins at its stamp; 0 stands for now, as does a moment ago.

        Until a stamp in the future, the joints hold, or move to a point at that time.

        Raises:
            _Invalid: if it was to begin earlier.
        """
        clock, stamp_ns = self._session.clock, message.header.stamp_ns
        late_ns = clock.age_ns(stamp_ns) if stamp_ns else 0
        if late_ns >= 0:
            if refusal := clock.refusal(stamp_ns):
                why = f"it was to begin {seconds(late_ns):.3f} s ago: {refusal}"
                raise _Invalid(why, TrajectoryCode.OLD_HEADER_TIMESTAMP)
            return message
        points = [attrs.evolve(each, time_from_start_ns=each.time_from_start_ns - late_ns) for each in message.points]
        if points and message.points[0].time_from_start_ns <= 0:
            # It must be where the robot is, which the door checks of a point at time 0, and is waited at.
            first = points[0]
            still = {"velocities": 0.0 * first.velocities, "accelerations": 0.0 * first.accelerations}
            points = [attrs.evolve(first, time_from_start_ns=0, **still), *points]
        elif points:
            state = self._session.state
            assert state is not None
            command = dict(zip(self._session.config.robot.joint_names, state.command.tolist(), strict=True))
            zeros = np.zeros(len(message.joint_names))
            hold = attrs.evolve(
                points[0],
                time_from_start_ns=-late_ns,
                positions=np.array([command[joint] for joint in message.joint_names]),
                velocities=zeros[: points[0].velocities.size],
                accelerations=zeros[: points[0].accelerations.size],
            )
            points = [hold, *points]
        return attrs.evolve(message, points=tuple(points))


def _tolerances(key: str, given: list[dict[str, Any]]) -> dict[str, float]:
    """Tolerances of positions by joint; 0 stands for the executor's own, below 0 for none, as in ros2_control."""
    for each in given:
        for name in ("position", "velocity", "acceleration"):
            if not math.isfinite(each[name]):
                raise _Invalid(f"{key}: {each['name']}: {name} is {each[name]}; it must be a finite number")
        if each["velocity"] > 0 or each["acceleration"] > 0:
            raise _Invalid(
                f"{key}: {each['name']}: tolerances of velocities and accelerations are not checked; leave them out"
            )
    return {each["name"]: each["position"] if each["position"] >= 0 else -1.0 for each in given}

"""Goals of ROS's actions for the executors of a run, as ros2_control's controllers take them.

What speaks to clients (a node of rclpy's, or Zenoh) passes heads: plain mappings whose key `op` says what they are.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Mapping
from enum import IntEnum
from typing import Any, Protocol

import attrs
import numpy as np

from ibrobot_core.api import (
    NS_PER_S,
    ExecutorDescriptor,
    GoalRejected,
    IbrobotError,
    JointTrajectory,
    seconds,
    trajectory_goal,
)
from ibrobot_core.app import ControlState, ExecutorConfig, RunAccess
from ibrobot_ros2.codec import decode

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


class Wire(Protocol):
    """Passes heads to clients. `op` is `action` (an action is offered), `decided`, `feedback` or `ended`."""

    def send(self, head: Mapping[str, Any]) -> object:
        """Pass one on."""


def action_of(executor: ExecutorConfig, gripper_action: str) -> tuple[str, str]:
    """The name of an executor's action, and its type."""
    if executor.goals == "trajectory":
        return f"/{executor.name}/follow_joint_trajectory", "control_msgs/action/FollowJointTrajectory"
    return f"/{executor.name}/gripper_cmd", f"control_msgs/action/{gripper_action}"


def with_goals(session: RunAccess) -> dict[str, ExecutorConfig]:
    """The executors of a run that take goals, by name."""
    found = {}
    for name, executor in session.config.executors.items():
        descriptor = session.registry.find("executor", executor.type)
        assert isinstance(descriptor, ExecutorDescriptor)
        if not descriptor.streams:
            found[name] = executor
    return found


class Actions:
    """Passes goals and cancels of ROS to control, and what becomes of them back.

    Args:
        session: the run.
        executors: names of those that are offered.
        named: the full name of an action, from that without namespace.
        who: where goals come from, for the log and their names, e.g. `ros`.
        gripper_action: the action of executors that take a position.

    A goal replaces the one before, of any client, as on ros2_control's controllers: also one of the run's own planner,
    which then reports its motion as replaced.
    """

    def __init__(
        self,
        session: RunAccess,
        executors: Collection[str],
        named: Callable[[str], str],
        who: str,
        gripper_action: str = GRIPPER_ACTIONS[0],
    ) -> None:
        self._session = session
        self._named = named
        self._who = who
        self._gripper_action = gripper_action
        self._executors = {name: each for name, each in with_goals(session).items() if name in executors}
        self._lock = threading.Lock()
        self._goals: dict[str, _Goal] = {}
        """Goals under way, by their name in control."""
        self._wire: Wire | None = None
        self._node = 0
        """Number of the node: goals of one that is gone are not those of the next."""

    def declare(self, wire: Wire) -> None:
        """Tell a new node which actions it offers."""
        self._wire = wire
        self._node += 1
        for executor in self._executors.values():
            name, type_name = action_of(executor, self._gripper_action)
            wire.send(
                {
                    "op": "action",
                    "name": self._named(name),
                    "type": type_name,
                    "executor": executor.name,
                    "joints": list(executor.joints),
                }
            )

    def take_goal(self, wire: Wire, head: Mapping[str, Any], payload: bytes, stops: int) -> None:
        """Decide about a goal, which was received after `stops` emergency stops."""
        executor = self._executors[head["executor"]]
        name = self._name(head["goal"])
        now_ns = self._session.clock.now_ns()
        try:
            goal = self._read(executor, head["fields"], payload)
            if self._session.faults:
                raise _Invalid(f"refused before a reset: {self._session.faults[-1]}")
            if self._session.held:
                raise _Invalid(f"the robot holds after a reset: {self._session.to_go_on()}")
            with self._lock:
                self._goals[name] = _Goal(head["goal"], executor.name, now_ns, now_ns)
            self._session.control.call("goal", executor=executor.name, goal_id=name, goal=goal, stops=stops)
        except IbrobotError as error:
            with self._lock:
                self._goals.pop(name, None)
            code = error.code if isinstance(error, _Invalid) else TrajectoryCode.INVALID_GOAL
            self._session.log.warning("%s: goal for %s rejected: %s: %s", self._who, executor.name, code.name, error)
            wire.send({"op": "decided", "goal": head["goal"], "accepted": False})
        else:
            wire.send({"op": "decided", "goal": head["goal"], "accepted": True})

    def cancel(self, wire: Wire, number: int) -> None:
        """Cancel a goal for its client."""
        accepted = False
        with self._lock:
            found = self._goals.get(self._name(number))
            if found is not None:
                found.canceled = accepted = True
        if found is not None:
            try:
                self._session.control.call("cancel", executor=found.executor)
            except IbrobotError as error:
                accepted = False
                self._session.log.warning("%s: %s: cancel failed: %s", self._who, found.executor, error)
        wire.send({"op": "decided", "goal": number, "accepted": accepted})

    def abandon(self, why: str) -> None:
        """Cancel all goals, since nobody can cancel them any more: the robot holds."""
        with self._lock:
            abandoned = {goal.executor for goal in self._goals.values()}
        for executor in abandoned:
            self._session.log.warning("%s: %s holds: %s", self._who, executor, why)
            try:
                self._session.control.call("cancel", executor=executor)
            except IbrobotError as error:
                self._session.log.warning("%s: %s: cancel failed: %s", self._who, executor, error)

    def take_event(self, event: Mapping[str, Any]) -> None:
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
        measured, index = self._session.measured(), self._index(goal.executor)[0]
        self._wire.send(
            {
                "op": "ended",
                "goal": goal.number,
                "state": state,
                "code": int(code),
                "message": event["message"],
                "position": float(measured.position[index]),
                "effort": float(measured.effort[index]),
                **{key: result[key] for key in ("stalled", "reached_goal") if key in result},
            }
        )

    def take_state(self, state: ControlState) -> None:
        """Send feedback of the goals under way."""
        with self._lock:
            due = [goal for goal in self._goals.values() if state.stamp_ns - goal.fed_ns >= FEEDBACK_NS]
        for goal in due:
            goal.fed_ns = state.stamp_ns
            columns = self._index(goal.executor)
            assert self._wire is not None
            self._wire.send(
                {
                    "op": "feedback",
                    "goal": goal.number,
                    "stamp_ns": state.stamp_ns,
                    "passed_ns": max(0, state.stamp_ns - goal.begun_ns),
                    "desired": state.command[columns].tolist(),
                    "actual": state.position[columns].tolist(),
                    "velocity": state.velocity[columns].tolist(),
                    "effort": state.effort[columns].tolist(),
                }
            )

    def _name(self, number: int) -> str:
        """The name in control of a goal of the present node."""
        return f"{self._who} {self._node} {number}"

    def _index(self, executor: str) -> Any:
        return self._session.config.robot.indices(self._executors[executor].joints)

    def _read(self, executor: ExecutorConfig, fields: Mapping[str, Any], payload: bytes) -> dict[str, Any]:
        """The goal in the executor's form.

        Raises:
            _Invalid: if ros2_control would reject it, too.
        """
        if executor.goals == "trajectory":
            message = decode(JointTrajectory.ros_type, payload)
            assert isinstance(message, JointTrajectory)
            return self._trajectory(executor, fields, message)
        if "names" not in fields:
            return {"position": fields["position"], "max_effort": fields["max_effort"]}
        if list(fields["names"]) not in ([], list(executor.joints)):
            raise _Invalid(f"names must be {', '.join(executor.joints)}, got {', '.join(fields['names'])}")
        if len(fields["position"]) != 1 or len(fields["max_effort"]) > 1:
            raise _Invalid(f"needs one position, and at most one effort, got {fields['position']}")
        if fields["velocity"]:
            raise _Invalid("a velocity cannot be given: the executor's option velocity is used")
        return {"position": fields["position"][0], "max_effort": (fields["max_effort"] or [0.0])[0]}

    def _trajectory(
        self, executor: ExecutorConfig, fields: Mapping[str, Any], message: JointTrajectory
    ) -> dict[str, Any]:
        if fields["other_joints"]:
            raise _Invalid("multi_dof_trajectory: joints with several degrees of freedom are not supported")
        if sorted(message.joint_names) != sorted(executor.joints):
            raise _Invalid(
                f"joint_names must be, in any order, {', '.join(executor.joints)}; got "
                f"{', '.join(message.joint_names) or 'none'}",
                TrajectoryCode.INVALID_JOINTS,
            )
        goal = trajectory_goal(self._begun(executor, message, fields["stamp_ns"]))
        for key in ("path_tolerance", "goal_tolerance"):
            goal[key] = _tolerances(key, fields[key])
        goal["goal_time"] = seconds(fields["goal_time_ns"])
        return goal

    def _begun(self, executor: ExecutorConfig, message: JointTrajectory, stamp_ns: int) -> JointTrajectory:
        """A trajectory that begins now, of one that begins at a stamp; 0 stands for now.

        What has passed is left out. Until a stamp in the future, the joints hold.
        """
        late_ns = self._session.clock.now_ns() - stamp_ns if stamp_ns else 0
        if not late_ns:
            return message
        points = [attrs.evolve(each, time_from_start_ns=each.time_from_start_ns - late_ns) for each in message.points]
        points = [each for each in points if each.time_from_start_ns > 0]
        if not points:
            raise _Invalid(f"it ended {seconds(late_ns):.3f} s ago", TrajectoryCode.OLD_HEADER_TIMESTAMP)
        if late_ns < 0:
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
            points = [hold, *(each for each in points if each.time_from_start_ns > -late_ns)]
        return attrs.evolve(message, points=tuple(points))


def _tolerances(key: str, given: list[list[Any]]) -> dict[str, float]:
    """Tolerances of positions by joint; 0 stands for the executor's own, below 0 for none, as in ros2_control."""
    for name, _, velocity, acceleration in given:
        if velocity > 0 or acceleration > 0:
            raise _Invalid(f"{key}: {name}: tolerances of velocities and accelerations are not checked; leave them out")
    return {name: position if position >= 0 else -1.0 for name, position, _, _ in given}

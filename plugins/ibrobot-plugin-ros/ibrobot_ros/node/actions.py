"""Action servers. The run decides about goals; the node reports for it.

Those of executors are as ros2_control's controllers offer them, those of services have the fields of their requests.
"""

from __future__ import annotations

import queue
import threading
import time
from typing import Any

import numpy as np
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.serialization import serialize_message

from ibrobot_ros.node.types import fill, find_type, plain
from ibrobot_ros.wire import Wire

_PATIENCE_S = 10.0
"""Longest wait for the run's decision about a goal [s]."""
_GLANCE_S = 0.001
_NS = 1_000_000_000


class _Goal:
    """A goal under way, or about to be decided about."""

    def __init__(self, server: _Server, number: int) -> None:
        self.server = server
        self.number = number
        self.handle: Any = None
        self.decided: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self.ended: dict[str, Any] | None = None
        self.end = threading.Event()


class _Server:
    """What differs between the types of actions."""

    def __init__(self, head: dict[str, Any]) -> None:
        self.address: dict[str, Any] = {key: head[key] for key in ("executor", "service") if key in head}
        """What of the run it is for."""
        self.joints: list[str] = head.get("joints", [])
        self.type = find_type(head["type"])

    def request(self, goal: Any) -> tuple[dict[str, Any], bytes]:
        """The goal for the run."""
        raise NotImplementedError

    def feedback(self, head: dict[str, Any]) -> Any:
        """The feedback of a state of the joints."""
        raise NotImplementedError

    def result(self, head: dict[str, Any]) -> Any:
        """The result of an ended goal."""
        raise NotImplementedError


class _Trajectory(_Server):
    """FollowJointTrajectory."""

    def request(self, goal: Any) -> tuple[dict[str, Any], bytes]:
        def tolerances(each: Any) -> list[list[Any]]:
            return [[t.name, t.position, t.velocity, t.acceleration] for t in each]

        stamp, leeway = goal.trajectory.header.stamp, goal.goal_time_tolerance
        return {
            "path_tolerance": tolerances(goal.path_tolerance),
            "goal_tolerance": tolerances(goal.goal_tolerance),
            "goal_time_ns": leeway.sec * _NS + leeway.nanosec,
            "stamp_ns": stamp.sec * _NS + stamp.nanosec,
            "other_joints": list(goal.multi_dof_trajectory.joint_names),
        }, serialize_message(goal.trajectory)

    def feedback(self, head: dict[str, Any]) -> Any:
        found = self.type.Feedback()
        found.header.stamp.sec, found.header.stamp.nanosec = divmod(head["stamp_ns"], _NS)
        found.joint_names = self.joints
        desired, actual = np.array(head["desired"]), np.array(head["actual"])
        found.desired.positions, found.actual.positions = desired, actual
        found.actual.velocities = np.array(head["velocity"])
        found.error.positions = desired - actual
        passed = found.desired.time_from_start
        passed.sec, passed.nanosec = divmod(head["passed_ns"], _NS)
        found.actual.time_from_start = found.error.time_from_start = passed
        return found

    def result(self, head: dict[str, Any]) -> Any:
        return self.type.Result(error_code=head["code"], error_string=head["message"])


class _Gripper(_Server):
    """GripperCommand."""

    def request(self, goal: Any) -> tuple[dict[str, Any], bytes]:
        return {"position": goal.command.position, "max_effort": goal.command.max_effort}, b""

    def feedback(self, head: dict[str, Any]) -> Any:
        return self._fill(self.type.Feedback(), head["actual"][0], head["effort"][0], head)

    def result(self, head: dict[str, Any]) -> Any:
        return self._fill(self.type.Result(), head["position"], head["effort"], head)

    def _fill(self, found: Any, position: float, effort: float, head: dict[str, Any]) -> Any:
        found.position, found.effort = position, effort
        found.stalled, found.reached_goal = head.get("stalled", False), head.get("reached_goal", False)
        return found


class _ParallelGripper(_Gripper):
    """ParallelGripperCommand."""

    def request(self, goal: Any) -> tuple[dict[str, Any], bytes]:
        command = goal.command
        return {
            "names": list(command.name),
            "position": list(command.position),
            "velocity": list(command.velocity),
            "max_effort": list(command.effort),
        }, b""

    def feedback(self, head: dict[str, Any]) -> Any:
        return self._state(self.type.Feedback(), head["actual"][0], head["effort"][0])

    def _fill(self, found: Any, position: float, effort: float, head: dict[str, Any]) -> Any:
        found.stalled, found.reached_goal = head.get("stalled", False), head.get("reached_goal", False)
        return self._state(found, position, effort)

    def _state(self, found: Any, position: float, effort: float) -> Any:
        found.state.name, found.state.position, found.state.effort = self.joints, [position], [effort]
        return found


class _Call(_Server):
    """An action that a service of the run is."""

    def request(self, goal: Any) -> tuple[dict[str, Any], bytes]:
        return plain(goal), b""

    def feedback(self, head: dict[str, Any]) -> Any:
        return fill(self.type.Feedback(), head["values"])

    def result(self, head: dict[str, Any]) -> Any:
        try:
            return fill(self.type.Result(), head["values"])
        except LookupError as error:  # this ROS has another definition
            return fill(self.type.Result(), {"success": False, "message": str(error)})


_SERVERS: dict[str, type[_Server]] = {
    "FollowJointTrajectory": _Trajectory,
    "GripperCommand": _Gripper,
    "ParallelGripperCommand": _ParallelGripper,
}


class Actions:
    """The action servers of a run's executors."""

    def __init__(self, node: Any, wire: Wire) -> None:
        self._node = node
        self._wire = wire
        self._lock = threading.Lock()
        self._count = 0
        self._goals: dict[int, _Goal] = {}

    def add(self, head: dict[str, Any], payload: bytes) -> None:
        """Offer an action."""
        try:
            kind = _Call if "service" in head else _SERVERS[head["type"].rpartition("/")[2]]
            server = kind(head)
        except LookupError as error:
            self._wire.send({"op": "trouble", "topic": head["name"], "what": f"not in ROS: {error}"})
            return
        asked: list[_Goal] = []

        def ask(request: Any) -> Any:
            goal = self._ask(server, request)
            asked[:] = [goal] if goal is not None else []
            return GoalResponse.REJECT if goal is None else GoalResponse.ACCEPT

        def accept(handle: Any) -> None:
            # rclpy calls this right after `ask`, and no other callback of this server in between.
            (goal,) = asked
            goal.handle = handle
            handle.execute(lambda handle: self._execute(goal))

        ActionServer(
            self._node, server.type, head["name"], execute_callback=lambda handle: None, goal_callback=ask,
            handle_accepted_callback=accept, cancel_callback=self._cancel,
            callback_group=MutuallyExclusiveCallbackGroup(),
        )  # fmt: skip

    def decide(self, head: dict[str, Any], payload: bytes) -> None:
        """Take the run's decision about a goal, or about a cancel."""
        goal = self._goals.get(head["goal"])
        if goal is not None:
            goal.decided.put(head)

    def give_feedback(self, head: dict[str, Any], payload: bytes) -> None:
        """Publish how a goal goes on."""
        goal = self._goals.get(head["goal"])
        if goal is not None and goal.handle is not None and not goal.end.is_set():
            goal.handle.publish_feedback(goal.server.feedback(head))

    def end(self, head: dict[str, Any], payload: bytes) -> None:
        """Take the end of a goal."""
        goal = self._goals.get(head["goal"])
        if goal is not None:
            goal.ended = head
            goal.end.set()

    def _ask(self, server: _Server, request: Any) -> _Goal | None:
        """Ask the run about a goal; None if it rejects it."""
        with self._lock:
            self._count += 1
            goal = self._goals[self._count] = _Goal(server, self._count)
        fields, payload = server.request(request)
        self._wire.send({"op": "goal", "goal": goal.number, **server.address, "fields": fields}, payload)
        if self._decision(goal):
            return goal
        self._wire.send({"op": "cancel", "goal": goal.number, **server.address})  # should the run accept it too late
        del self._goals[goal.number]
        return None

    def _decision(self, goal: _Goal) -> bool:
        try:
            return bool(goal.decided.get(timeout=_PATIENCE_S)["accepted"])
        except queue.Empty:
            return False

    def _cancel(self, handle: Any) -> Any:
        goal = next((each for each in list(self._goals.values()) if each.handle is handle), None)
        if goal is None or goal.end.is_set():
            return CancelResponse.REJECT
        self._wire.send({"op": "cancel", "goal": goal.number, **goal.server.address})
        return CancelResponse.ACCEPT if self._decision(goal) else CancelResponse.REJECT

    def _execute(self, goal: _Goal) -> Any:
        """Wait for the end of a goal, in a thread of the executor's pool."""
        goal.end.wait()
        assert goal.ended is not None
        state = goal.ended["state"]
        if state == "canceled":
            # rclpy notes an accepted cancel only after the callback that accepts it.
            while not goal.handle.is_cancel_requested:
                time.sleep(_GLANCE_S)
            goal.handle.canceled()
        elif state == "succeeded":
            goal.handle.succeed()
        else:
            goal.handle.abort()
        del self._goals[goal.number]
        return goal.server.result(goal.ended)

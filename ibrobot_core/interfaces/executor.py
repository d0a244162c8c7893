"""Executors: what turns plans and goals into one setpoint per tick; runs in the control process, ahead of safety."""

from __future__ import annotations

import enum
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

import attrs

from ibrobot_core.errors import GoalRejected
from ibrobot_core.interfaces.hardware import JointReading
from ibrobot_core.messages import JointTrajectory
from ibrobot_core.robot import Vector


@attrs.frozen(eq=False)
class Plan:
    """Setpoints by time for an executor's joints: `positions[i]` belongs to `start_ns + i * step_ns`."""

    start_ns: int
    step_ns: int
    positions: Vector
    """[rad], shape (N, J)."""


class GoalState(enum.StrEnum):
    """How a goal stands; names as in action_msgs/msg/GoalStatus."""

    EXECUTING = "executing"
    SUCCEEDED = "succeeded"
    CANCELED = "canceled"
    ABORTED = "aborted"


@attrs.frozen
class GoalStatus:
    """A goal's state, and what to know of it."""

    goal_id: str
    state: GoalState
    message: str = ""
    result: Mapping[str, Any] = attrs.field(factory=dict)


class Executor(ABC):
    """Owns joints while active. Called once a tick, from one thread.

    Everything an executor returns goes through the safety layer; it need not limit, only say what it wants.
    """

    accepts_plans: ClassVar[bool] = False
    """True for executors of streamed setpoints (the dispatcher's and teleop's); they implement `set_plan`."""

    joints: tuple[str, ...]

    @abstractmethod
    def activate(self, measured: JointReading) -> None:
        """Take the joints over at `measured`, shape (J,) in `joints` order, and hold there."""

    @abstractmethod
    def update(self, measured: JointReading) -> Vector:
        """The setpoint [rad] for this tick, shape (J,); `measured.stamp_ns` is the tick's time."""

    @property
    def wants_relax(self) -> bool:
        """Whether, from its last `update` on, torque should be off instead of following its setpoint.

        False after `activate`. The loop puts torque back on when no active executor wants it off.
        """
        return False

    def deactivate(self) -> None:
        """Give the joints up; forget plans and goals."""

    def set_plan(self, plan: Plan) -> None:
        """Replace the plan; only where `accepts_plans`. One that cannot be followed is counted, the old one stays."""
        raise NotImplementedError(f"{type(self).__name__} accepts no plans")

    def set_goal(self, goal_id: str, goal: Mapping[str, Any], measured: JointReading) -> None:
        """Begin a goal, replacing a present one without a step in the setpoint.

        Raises:
            GoalRejected: when it is malformed or this executor takes no goals; the old goal goes on.
        """
        raise GoalRejected(f"{type(self).__name__} accepts no goals")

    def cancel(self, measured: JointReading) -> None:
        """Give up the present goal, if any, and hold the measured position."""

    def pop_status(self) -> GoalStatus | None:
        """A goal's change of state that was not yet reported, or None."""
        return None

    def counters(self) -> Mapping[str, int]:
        """What it refused or went without, by name, since construction; e.g. `stale`, `refused_nonfinite`."""
        return {}


def trajectory_goal(message: JointTrajectory) -> dict[str, Any]:
    """The goal that executors with `goals="trajectory"` in their descriptor take, of plain numbers, strings and lists.

    It starts when it is accepted: the stamp of the message is not used.

    Returns:
        Names and points, as
        `{"trajectory": {"joint_names": […], "points": […]}}`. Each point has `time_from_start_ns` and, where the
        message has them, `positions` [rad], `velocities` [rad/s] and `accelerations` [rad/s^2], in the order of the
        names.

    Raises:
        GoalRejected: for a point with efforts, which positions cannot follow.
    """
    points = []
    for index, point in enumerate(message.points):
        if point.effort.size:
            raise GoalRejected(f"point {index} has efforts; only positions, velocities and accelerations are followed")
        motion = {"positions": point.positions, "velocities": point.velocities, "accelerations": point.accelerations}
        given = {name: values.tolist() for name, values in motion.items() if values.size}
        points.append({"time_from_start_ns": point.time_from_start_ns, **given})
    return {"trajectory": {"joint_names": list(message.joint_names), "points": points}}

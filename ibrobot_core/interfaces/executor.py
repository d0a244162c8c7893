"""Executors, which turn plans and goals into one setpoint per tick, in the control process, before the safety layer."""

from __future__ import annotations

import enum
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar, Literal

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
    """State of a goal; names as in action_msgs/msg/GoalStatus."""

    EXECUTING = "executing"
    SUCCEEDED = "succeeded"
    CANCELED = "canceled"
    ABORTED = "aborted"


@attrs.frozen
class GoalStatus:
    """A goal's state, with an explanation."""

    goal_id: str
    state: GoalState
    message: str = ""
    result: Mapping[str, Any] = attrs.field(factory=dict)


@attrs.frozen
class FollowTrajectory:
    """A goal for executors with `goals="trajectory"` in their descriptor; the stamp of the trajectory is ignored."""

    trajectory: JointTrajectory
    """Without efforts: positions do not follow them."""
    path_tolerance: float | Mapping[str, float] = 0.0
    """[rad], of all joints or by joint; 0: as the executor's options say, -1: none."""
    goal_tolerance: float | Mapping[str, float] = 0.0
    """As `path_tolerance`, at the end."""
    goal_time: float = 0.0
    """Longest time to reach the end after its time [s]; 0: as the executor's options say, -1: any."""
    takes_over: str | None = None
    """Name of the running goal that it takes over from; it then begins at `at_ns`, and else when it is accepted."""
    at_ns: int = 0
    """Time along the running trajectory [ns]."""


@attrs.frozen
class MoveJoint:
    """A goal for executors with `goals="position"` in their descriptor: the position of their joint [rad]."""

    position: float
    max_effort: float = 0.0
    """[Nm]; 0: no limit."""
    speed: float = 1.0
    """Fraction of the joint's velocity limit that its setpoint may use."""


@attrs.frozen
class SlowDown:
    """Slow down along the present goal, and hold; a goal for executors with any goals.

    Its `measured` positions are those at which the commands come to rest if they brake now. Setpoints may be far ahead
    of them, e.g. if an agent's authority limits the speed or the guard holds a joint back: hold there, then.
    """

    stop: Literal[True] = True


ExecutorGoal = FollowTrajectory | MoveJoint | SlowDown


class Executor(ABC):
    """Owns joints while active. Called once per tick, from one thread.

    The safety layer limits everything that an executor returns, so points of a plan may be fast. But a new goal begins
    where the setpoint is: it makes no step beyond the velocity limits.
    """

    accepts_plans: ClassVar[bool] = False
    """Whether it accepts streamed setpoints, from the dispatcher or teleop; it then implements `set_plan`."""

    joints: tuple[str, ...]

    @abstractmethod
    def activate(self, measured: JointReading) -> None:
        """Take over the joints, shape (J,) as in `joints`, and hold at `measured`, where the commands rest."""

    @abstractmethod
    def update(self, measured: JointReading) -> Vector:
        """The setpoint [rad] for this tick, shape (J,); `measured.stamp_ns` is the tick's time."""

    @property
    def wants_relax(self) -> bool:
        """Whether the torque should be off instead of following the setpoint of the last `update`.

        False after `activate`. The loop switches the torque on again when no active executor wants it off.
        """
        return False

    @property
    def is_stale(self) -> bool:
        """Whether the setpoints of the last plan are too old to follow: for executors with `accepts_plans`.

        Stale means brake: the joints brake at once, from where they are commanded, and the executor is activated where
        they come to rest. It does not travel on to its last setpoint.
        """
        return False

    def deactivate(self) -> None:
        """Release the joints; discard plans and goals."""

    def set_plan(self, plan: Plan) -> None:
        """Replace the plan; `update` meets each of its points in time. An invalid one is counted, the old one kept."""
        raise NotImplementedError(f"{type(self).__name__} accepts no plans")

    def set_goal(self, goal_id: str, goal: ExecutorGoal, measured: JointReading) -> None:
        """Begin a goal; it replaces a present one without a step in the setpoint beyond `max_velocity`.

        Raises:
            GoalRejected: if it is wrong or this executor accepts no goals; the old goal continues.
        """
        raise GoalRejected(f"{type(self).__name__} accepts no goals")

    def cancel(self, measured: JointReading) -> None:
        """Cancel the present goal, if any, and hold the measured position."""

    def note_guard(self, overruled: str) -> None:
        """Called after a tick in which the guard changed the setpoint, with what it was about to touch; see `Guard`."""

    def pop_status(self) -> GoalStatus | None:
        """The next unreported change of a goal's state, or None."""
        return None

    def counters(self) -> Mapping[str, int]:
        """Counts of refused or missing input since construction, by name; e.g. `stale`, `refused_nonfinite`."""
        return {}

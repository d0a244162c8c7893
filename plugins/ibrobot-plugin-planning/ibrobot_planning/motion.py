"""Requests and result of the services of a planning mode: those of IB-Robot as attrs classes."""

from __future__ import annotations

from typing import Literal

import attrs

from ibrobot_core.api import Header, JointState, PlanCode, Pose, Vector, documented, option

type Outcome = Literal["SUCCEEDED", "REJECTED", "PLANNING_FAILED", "EXECUTION_FAILED", "CANCELLED"]


@documented
@attrs.frozen
class MoveToPose:
    """Request of ibrobot_msgs/srv/MoveToPose."""

    target_pose: Pose = option(help="of the tool centre point, in the base frame")
    velocity_scaling: float = option(0.0, help="fraction of the velocity limits, in (0, 1]; 0 means 1")


@attrs.frozen(eq=False)
class JointTarget:
    """A sensor_msgs/msg/JointState as a goal, of which only names and positions are read."""

    name: tuple[str, ...]
    position: Vector
    """One for each joint [rad]."""
    velocity: Vector | None = None
    effort: Vector | None = None
    header: Header = Header()


@documented
@attrs.frozen
class MoveToConfiguration:
    """Request of ibrobot_msgs/srv/MoveToConfiguration."""

    target_joint_state: JointState | JointTarget = option(
        plain=JointTarget, help="names and positions [rad]; all other joints stay"
    )
    velocity_scaling: float = option(0.0, help="fraction of the velocity limits, in (0, 1]; 0 means 1")


@attrs.frozen
class MoveResult:
    """Response of ibrobot_msgs/srv/MoveToPose, with MoveIt's code."""

    success: bool
    message: str
    """The error in one sentence; empty after a success."""
    execution_time_s: float
    outcome: Outcome
    code: PlanCode
    """`code.name` is MoveIt's, e.g. NO_IK_SOLUTION."""
    position_error_m: float = 0.0
    """Distance of the planned tool position from the requested one [m]."""
    orientation_error_rad: float = 0.0
    """Angle between the planned orientation, or axis, and the requested one [rad]."""
    fraction: float = 1.0
    """Fraction of a straight path that was planned."""
    alternative: int = 0
    """Index of the goal that was chosen, of several."""

"""Planners, which compute a trajectory to a goal, in the host."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Literal

import attrs
import numpy as np

from ibrobot_core.api import Descriptor, PlanCode, PlanningError

if TYPE_CHECKING:
    from ibrobot_kinematics import PathConstraints

    from ibrobot_core.api import JointTrajectory, Pose, Robot, Vector, Vector3

OrientationPolicy = Literal["refuse", "nearest", "keep_axis", "arm_plane", "current", "free"]
LEAST_SCALING = 0.01
"""Least fraction of the velocity and acceleration limits that a goal may ask for."""


@attrs.frozen(eq=False)
class JointGoal:
    """Joint positions to reach; other joints stay where they are."""

    joints: tuple[str, ...]
    positions: Vector
    """[rad], shape (len(joints),)."""
    tolerance: float = 0.0
    """Allowed distance of each joint from its goal position [rad], if that position is blocked."""


@attrs.frozen
class NamedGoal:
    """A pose of `robot.description.poses`, for the planned joints."""

    name: str


@attrs.frozen
class PositionGoal:
    """A position of the tool centre point, alone or with the direction of the tool's z axis, in the base frame."""

    position: Vector3
    """[m]."""
    axis: Vector3 | None = None
    """Direction of the tool's z axis, e.g. (0, 0, -1) for down; any nonzero length. None leaves it free."""
    position_tolerance: float = 0.001
    """[m]."""
    axis_tolerance: float = 0.01
    """[rad]."""


@attrs.frozen
class PoseGoal:
    """A pose of the tool centre point to reach, in the robot's base frame."""

    pose: Pose
    position_tolerance: float = 0.001
    """[m]."""
    orientation_tolerance: float | None = 0.01
    """[rad]; None leaves the orientation free."""
    beyond_reach: OrientationPolicy = "refuse"
    """How to treat an orientation that the arm cannot reach at this position, e.g. with fewer than six joints: refuse
    it; use the nearest one; keep the direction of the tool's z axis; rotate that axis into the plane of the arm; stay
    near the tool's present orientation; or leave the orientation free. The result has the deviation."""


@attrs.frozen
class LinearGoal:
    """A path of the tool centre point along straight lines through waypoints, from its present pose."""

    waypoints: tuple[PositionGoal | PoseGoal, ...]
    least_fraction: float = 1.0
    """Fraction of the path's length that must be possible, in (0, 1]."""


@attrs.frozen(eq=False)
class ConstrainedGoal:
    """A goal whose whole way keeps path constraints. A goal of its own, so that no planner overlooks them."""

    goal: JointGoal | NamedGoal | PositionGoal | PoseGoal | LinearGoal
    constraints: PathConstraints


@attrs.frozen
class AnyGoal:
    """Alternative goals: the planner uses the first one that it can reach."""

    goals: tuple[JointGoal | NamedGoal | PositionGoal | PoseGoal | ConstrainedGoal, ...]


type Goal = JointGoal | NamedGoal | PositionGoal | PoseGoal | AnyGoal | LinearGoal | ConstrainedGoal


def constrains(goal: Goal | None) -> bool:
    """Whether a goal, or one of its alternatives, has path constraints."""
    return isinstance(goal, ConstrainedGoal) or (isinstance(goal, AnyGoal) and any(map(constrains, goal.goals)))


def invalid_goal(message: str) -> PlanningError:
    """The error for an invalid goal, with MoveIt's code."""
    return PlanningError(message, PlanCode.INVALID_GOAL_CONSTRAINTS)


def scaling_fault(name: str, scaling: float) -> str:
    """Why a fraction of the limits is invalid; empty if it is valid.

    Args:
        name: its name, e.g. `velocity_scaling`.
        scaling: the fraction.
    """
    if LEAST_SCALING <= scaling <= 1:  # false for NaN
        return ""
    return f"{name} is {scaling}, must be from {LEAST_SCALING} to 1"


@attrs.frozen(eq=False)
class PlanRequest:
    """A planning request: start, goal and speed."""

    joints: tuple[str, ...]
    """The joints to plan for; the trajectory has exactly these, in this order."""
    start: Vector
    """[rad], shape (len(joints),)."""
    goal: Goal
    velocity_scaling: float = 1.0
    """Fraction of the velocity limits, in (0, 1]."""
    acceleration_scaling: float = 1.0
    """Fraction of the acceleration limits, in (0, 1]."""
    others: Mapping[str, float] = attrs.field(factory=dict)
    """Positions [rad] of joints that do not move, e.g. the gripper; omitted joints are assumed to be at 0."""
    check_wanted: Callable[[], None] = lambda: None
    """Raises a PlanningError once nobody wants the plan any more. Planners that search call it often."""


def checked_start(request: PlanRequest, robot: Robot) -> Vector:
    """Check the joints, the start and the scalings of a request. Returns the start [rad], shape (J,).

    Raises:
        PlanningError: for unknown joints, a start of another shape or that is not finite, and invalid scalings.
    """
    for name in (*request.joints, *request.others):
        if name not in robot.joint_names:
            raise PlanningError(
                f"no joint {name!r}; the joints are: {', '.join(robot.joint_names)}", PlanCode.INVALID_GROUP_NAME
            )
    start = np.array(request.start, dtype=float)
    if start.shape != (len(request.joints),):
        raise PlanningError(
            f"start has shape {start.shape}, must be ({len(request.joints)},): one per joint",
            PlanCode.INVALID_ROBOT_STATE,
        )
    for name, scaling in (("velocity", request.velocity_scaling), ("acceleration", request.acceleration_scaling)):
        if fault := scaling_fault(f"{name}_scaling", scaling):
            raise PlanningError(fault)
    for name, value in zip(request.joints, start.tolist(), strict=True):
        if not np.isfinite(value):
            raise PlanningError(f"start of joint {name} is {value}, must be finite", PlanCode.INVALID_ROBOT_STATE)
    return start


def joint_target(goal: JointGoal, robot: Robot, joints: Sequence[str], start: Vector) -> Vector:
    """Goal positions of the planned `joints` [rad], shape (len(joints),).

    Raises:
        PlanningError: for unknown joints, wrong shapes, and positions outside the limits.
    """
    positions = np.asarray(goal.positions, dtype=float)
    if positions.shape != (len(goal.joints),):
        raise invalid_goal(f"goal has positions of shape {positions.shape}, must be ({len(goal.joints)},)")
    if not 0 <= goal.tolerance < np.inf:
        raise invalid_goal(f"goal has a tolerance of {goal.tolerance} rad, must be at least 0")
    target = np.array(start, dtype=float)
    limits = {joint.name: (joint.lower, joint.upper) for joint in robot.joints}
    for i, (name, value) in enumerate(zip(goal.joints, positions.tolist(), strict=True)):
        if name not in limits:
            raise invalid_goal(f"no joint {name!r}; the joints are: {', '.join(limits)}")
        if name not in joints:
            raise invalid_goal(f"goal names joint {name!r}, which is not planned: {', '.join(joints)}")
        if name in goal.joints[:i]:
            raise invalid_goal(f"goal names joint {name!r} twice")
        lower, upper = limits[name]
        # Written so that NaN fails it.
        if not lower <= value <= upper:
            raise invalid_goal(f"goal of joint {name} is {value} rad, must be within {lower} .. {upper} rad")
        target[joints.index(name)] = value
    return target


@attrs.frozen(eq=False)
class PlanResult:
    """A trajectory, and how well it meets the goal."""

    trajectory: JointTrajectory
    """The motion from rest to rest; its first point is at time zero."""
    fraction: float = 1.0
    """Fraction of the path of a `LinearGoal` that it covers."""
    alternative: int = 0
    """Index of the goal of an `AnyGoal` that it reaches."""
    position_error: float = 0.0
    """Distance of the tool's final position from the goal [m]."""
    orientation_error: float = 0.0
    """Angle between the tool's final orientation and the goal's orientation or axis [rad]."""


class Planner(ABC):
    """Computes trajectories."""

    @abstractmethod
    def plan(self, request: PlanRequest) -> PlanResult:
        """Plan a trajectory from rest at `start` to rest at the goal, within limits, with its first point at time zero.

        Raises:
            PlanningError: e.g. if the goal is out of reach, outside limits, or of an unsupported kind; with MoveIt's
                code for the reason.
        """

    def blocked(self, trajectory: JointTrajectory, others: Mapping[str, float], from_ns: int = 0) -> str:
        """What a trajectory touches of what only the planner knows, in words; empty if nothing.

        The run checks trajectories against its own world. It calls this in addition, before a motion and during it,
        every 20 ms and from another thread than `plan`.

        Args:
            trajectory: with velocities and accelerations.
            others: positions [rad] of joints that it does not move.
            from_ns: where it begins [ns]; what lies before is past.
        """
        return ""

    def load(self) -> None:
        """Prepare the planner, e.g. load the collision model."""

    def close(self) -> None:
        """Release resources of `load`. Safe to call twice."""


@attrs.frozen
class PlannerDescriptor(Descriptor[Planner]):
    """A motion planner."""

    tool_goals: bool = True
    """Whether it takes every goal; otherwise only `JointGoal`."""

"""Planners: what turns a goal into a trajectory; runs in the host."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Literal

import attrs

from ibrobot_core.messages import JointTrajectory, Pose, Vector3
from ibrobot_core.robot import Vector

OrientationPolicy = Literal["refuse", "nearest", "keep_axis", "arm_plane", "current", "free"]


@attrs.frozen(eq=False)
class JointGoal:
    """Joint positions to reach; joints not named stay."""

    joints: tuple[str, ...]
    positions: Vector
    """[rad], shape (len(joints),)."""
    tolerance: float = 0.0
    """How far from its position each joint may end [rad], where the position itself is blocked."""


@attrs.frozen
class NamedGoal:
    """A pose of `robot.description.poses`; its positions of the planned joints."""

    name: str


@attrs.frozen
class PositionGoal:
    """A position of the tool centre point, alone or with the direction of the tool's z axis, in the base frame."""

    position: Vector3
    """[m]."""
    axis: Vector3 | None = None
    """Where the tool's z axis shall point, e.g. (0, 0, -1) for down; of any length above 0. None leaves it free."""
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
    """What to do with an orientation that the arm cannot take at this position, as with fewer than six joints: refuse;
    take the nearest one; keep the direction of the tool's z axis; turn that axis into the plane in which the arm
    stands; keep the tool's present orientation as nearly as possible; or leave the orientation free. The result says
    how far off the orientation is."""


@attrs.frozen
class AnyGoal:
    """Alternatives: the planner takes the first that it can reach."""

    goals: tuple[JointGoal | NamedGoal | PositionGoal | PoseGoal, ...]


@attrs.frozen
class LinearGoal:
    """A path of the tool centre point along straight lines through waypoints, from where the tool is."""

    waypoints: tuple[PositionGoal | PoseGoal, ...]
    least_fraction: float = 1.0
    """How much of the path, of its length, must be possible, in (0, 1]."""


type Goal = JointGoal | NamedGoal | PositionGoal | PoseGoal | AnyGoal | LinearGoal


@attrs.frozen(eq=False)
class PlanRequest:
    """From where, to where, how fast."""

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
    """Positions [rad] of joints that do not move meanwhile, e.g. the gripper's; those left out are taken to be at 0."""


@attrs.frozen(eq=False)
class PlanResult:
    """A trajectory, and how it relates to what was asked."""

    trajectory: JointTrajectory
    """From rest to rest, its first point at time zero."""
    fraction: float = 1.0
    """How much of the path of a `LinearGoal` it covers."""
    alternative: int = 0
    """Which goal of an `AnyGoal` it reaches."""
    position_error: float = 0.0
    """Distance of the tool's end from the position asked for [m]."""
    orientation_error: float = 0.0
    """Angle between the tool's end and the orientation or axis asked for [rad]."""


class Planner(ABC):
    """One call, one trajectory."""

    @abstractmethod
    def plan(self, request: PlanRequest) -> PlanResult:
        """A trajectory from rest at `start` to rest at the goal, within limits, its first point at time zero.

        Raises:
            PlanningError: e.g. a goal out of reach or outside limits, or of a kind that this planner does not know;
                with MoveIt's code for the reason.
        """

    def load(self) -> None:
        """Prepare, e.g. load the collision model; when it returns the planner is ready."""

    def close(self) -> None:
        """Release what `load` took. Safe to call twice."""

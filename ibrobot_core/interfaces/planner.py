"""Planners: what turns a goal into a trajectory; runs in the host."""

from __future__ import annotations

from abc import ABC, abstractmethod

import attrs

from ibrobot_core.messages import JointTrajectory, Pose
from ibrobot_core.robot import Vector


@attrs.frozen(eq=False)
class JointGoal:
    """Joint positions to reach; joints not named stay."""

    joints: tuple[str, ...]
    positions: Vector
    """[rad], shape (len(joints),)."""


@attrs.frozen
class PoseGoal:
    """A pose of the tool centre point to reach, in the robot's base frame."""

    pose: Pose
    position_tolerance: float = 0.001
    """[m]."""
    orientation_tolerance: float | None = 0.01
    """[rad]; None leaves the orientation free."""


@attrs.frozen(eq=False)
class PlanRequest:
    """From where, to where, how fast."""

    joints: tuple[str, ...]
    """The joints to plan for; the trajectory has exactly these, in this order."""
    start: Vector
    """[rad], shape (len(joints),)."""
    goal: JointGoal | PoseGoal
    velocity_scaling: float = 1.0
    """Fraction of the velocity limits, in (0, 1]."""
    acceleration_scaling: float = 1.0
    """Fraction of the acceleration limits, in (0, 1]."""


class Planner(ABC):
    """One call, one trajectory."""

    @abstractmethod
    def plan(self, request: PlanRequest) -> JointTrajectory:
        """A trajectory from rest at `start` to rest at the goal, within limits, its first point at time zero.

        Raises:
            PlanningError: e.g. a goal out of reach or outside limits, or of a kind that this planner does not know.
        """

    def load(self) -> None:
        """Prepare, e.g. load the collision model; when it returns the planner is ready."""

    def close(self) -> None:
        """Release what `load` took. Safe to call twice."""

"""Requests and answers of the services that plan, as attrs classes."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import attrs
import numpy as np
from ibrobot_kinematics.poses import orientation
from ibrobot_kinematics.rotations import from_rpy

from ibrobot_core.api import (
    AnyGoal,
    Goal,
    Header,
    JointGoal,
    JointState,
    JointTrajectory,
    JointTrajectoryPoint,
    LinearGoal,
    NamedGoal,
    OrientationPolicy,
    PlanCode,
    PlanningError,
    Pose,
    PoseGoal,
    PoseStamped,
    PositionGoal,
    Quaternion,
    Vector3,
    documented,
    option,
)
from ibrobot_planning.goals.text import LEAST_SCALING, Target

_NEARLY_ONE = 1e-3
"""Allowed deviation of a quaternion's length from 1."""


@documented
@attrs.frozen
class GoalOptions:
    """A goal: a named pose, joints, or a position of the tool, alone or with a direction or an orientation."""

    pose: str | None = option(None, help="a pose of the robot YAML or the SRDF")
    joints: Mapping[str, float] | None = option(None, unit="rad", help="positions of joints; the others stay")
    xyz: tuple[float, float, float] | None = option(None, unit="m", help="position of the tool in the base frame")
    axis: tuple[float, float, float] | None = option(None, help="direction of the tool's z axis, e.g. [0, 0, -1]")
    rpy: tuple[float, float, float] | None = option(None, unit="rad", help="orientation of the tool")
    quaternion: tuple[float, float, float, float] | None = option(None, help="x, y, z, w, in place of rpy")
    joint_tolerance: float = option(0.0, unit="rad", ge=0, help="allowed deviation if the joints' goal is blocked")
    position_tolerance: float = option(0.001, unit="m", gt=0, help="of the tool")
    axis_tolerance: float = option(0.01, unit="rad", gt=0, help="of the axis")
    orientation_tolerance: float = option(0.01, unit="rad", gt=0, help="of the orientation")
    beyond_reach: OrientationPolicy = option("refuse", help="how to treat an orientation that the arm cannot take")

    def __attrs_post_init__(self) -> None:
        goals = {"pose": self.pose, "joints": self.joints, "xyz": self.xyz}
        given = [key for key, value in goals.items() if value is not None]
        if len(given) != 1:
            raise ValueError(f"a goal has one of pose, joints and xyz; got {' and '.join(given) or 'none'}")
        turns = {"axis": self.axis, "rpy": self.rpy, "quaternion": self.quaternion}
        turned = [key for key, value in turns.items() if value is not None]
        if turned and self.xyz is None:
            raise ValueError(f"{turned[0]} needs a position: xyz")
        if len(turned) > 1:
            raise ValueError(f"{turned[0]} and {turned[1]} exclude each other")
        if self.beyond_reach != "refuse" and turned not in (["rpy"], ["quaternion"]):
            raise ValueError("beyond_reach needs an orientation: rpy or quaternion")
        if self.axis is not None and not any(self.axis):
            raise ValueError("axis has no length; give a direction, e.g. [0, 0, -1] for down")
        if self.quaternion is not None and abs(math.hypot(*self.quaternion) - 1) > _NEARLY_ONE:
            raise ValueError(
                f"quaternion has length {math.hypot(*self.quaternion):.3g}, must be 1; the order is x, y, z, w"
            )

    def goal(self) -> JointGoal | NamedGoal | PositionGoal | PoseGoal:
        """The goal as planners take it."""
        if self.pose is not None:
            return NamedGoal(self.pose)
        if self.joints is not None:
            return JointGoal(tuple(self.joints), np.array(list(self.joints.values())), self.joint_tolerance)
        assert self.xyz is not None
        position, axis = Vector3(*self.xyz), None if self.axis is None else Vector3(*self.axis)
        turn = Quaternion(*self.quaternion) if self.quaternion is not None else None
        if self.rpy is not None:
            turn = orientation(from_rpy(*self.rpy))
        if turn is None:
            return PositionGoal(position, axis, self.position_tolerance, self.axis_tolerance)
        return PoseGoal(Pose(position, turn), self.position_tolerance, self.orientation_tolerance, self.beyond_reach)


def _few(most: int) -> Callable[[object, attrs.Attribute[Any], Sequence[object]], None]:
    """A validator of the number of items."""

    def check(instance: object, attribute: attrs.Attribute[Any], value: Sequence[object]) -> None:
        if len(value) > most:
            raise ValueError(f"{len(value)} are too many, at most {most} are planned for")

    return check


def _scaling(what: str) -> Any:
    return option(1.0, ge=LEAST_SCALING, le=1, help=f"fraction of the {what} limits")


@documented
@attrs.frozen
class MoveRequest:
    """A request to `/move_action`: move to the first of several goals that can be reached."""

    goals: tuple[GoalOptions, ...] = option(validator=_few(20), help="alternatives, in order of preference")
    velocity_scaling: float = _scaling("velocity")
    acceleration_scaling: float = _scaling("acceleration")

    def goal(self) -> Goal:
        """The goal as planners take it.

        Raises:
            PlanningError: without goals.
        """
        return any_goal(self.goals)


@documented
@attrs.frozen
class PlanQuery:
    """A request to `/plan_kinematic_path`: plan to the first of several goals that can be reached, and stay."""

    goals: tuple[GoalOptions, ...] = option(validator=_few(20), help="alternatives, in order of preference")
    start: Mapping[str, float] = option(factory=dict, unit="rad", help="start; other joints are where they are")
    velocity_scaling: float = _scaling("velocity")
    acceleration_scaling: float = _scaling("acceleration")


@documented
@attrs.frozen
class GoTo:
    """A request to `/planning/go_to`."""

    goal: str | Goal | Target = option(plain=str, help="a pose's name, joints, or a position of the tool, as `--goal`")


@documented
@attrs.frozen
class PlanAhead:
    """A request to `/planning/plan`: plan to a goal, and stay."""

    goal: str | Goal | Target = option(plain=str, help="as `/planning/go_to` takes it")
    start: Mapping[str, float] = option(factory=dict, unit="rad", help="start; other joints are where they are")


@documented
@attrs.frozen
class Numbered:
    """A request to `/planning/result`."""

    number: int = option(ge=0, help="what the service that took the goal answered with")


@documented
@attrs.frozen
class CartesianQuery:
    """A request to `/compute_cartesian_path`: plan straight lines of the tool through waypoints."""

    waypoints: tuple[GoalOptions, ...] = option(
        validator=_few(100), help="positions of the tool, with or without axis or orientation"
    )
    least_fraction: float = option(1.0, gt=0, le=1, help="fraction of the path that must be possible")
    start: Mapping[str, float] = option(factory=dict, unit="rad", help="start; other joints are where they are")
    velocity_scaling: float = _scaling("velocity")
    acceleration_scaling: float = _scaling("acceleration")

    def goal(self) -> LinearGoal:
        """The goal as planners take it.

        Raises:
            PlanningError: without waypoints, or for one that is not a position of the tool.
        """
        waypoints = tuple(each.goal() for each in self.waypoints)
        if not waypoints:
            raise PlanningError("a straight path needs at least one waypoint", PlanCode.INVALID_GOAL_CONSTRAINTS)
        for number, each in enumerate(waypoints):
            if not isinstance(each, PositionGoal | PoseGoal):
                raise PlanningError(
                    f"waypoint {number} is not a position of the tool: give xyz", PlanCode.INVALID_GOAL_CONSTRAINTS
                )
        return LinearGoal(waypoints, self.least_fraction)  # type: ignore[arg-type]


@documented
@attrs.frozen
class IkQuery:
    """A request to `/compute_ik`: joint positions for a position or pose of the tool."""

    goal: GoalOptions = option(help="position of the tool, with or without axis or orientation")
    start: Mapping[str, float] = option(factory=dict, unit="rad", help="start; other joints are where they are")
    avoid_collisions: bool = option(True, help="whether configurations that touch something are left out")


@documented
@attrs.frozen
class FkQuery:
    """A request to `/compute_fk`: poses of links."""

    joints: Mapping[str, float] = option(factory=dict, unit="rad", help="positions; other joints are where they are")
    links: tuple[str, ...] = option(
        (), validator=_few(100), help="links of the MJCF or the URDF, or the tip; only the tip if empty"
    )


@attrs.frozen(eq=False)
class PlanAnswer:
    """Answer of `/plan_kinematic_path` and `/compute_cartesian_path`."""

    code: PlanCode
    message: str = ""
    """The error in one sentence; empty after a success."""
    trajectory: JointTrajectory | None = None
    fraction: float = 0.0
    """Fraction of a straight path that the trajectory covers."""
    alternative: int = 0
    """Index of the goal that it reaches."""
    position_error_m: float = 0.0
    orientation_error_rad: float = 0.0
    planning_time_s: float = 0.0


@attrs.frozen(eq=False)
class IkAnswer:
    """Answer of `/compute_ik`."""

    code: PlanCode
    message: str = ""
    joint_state: JointState | None = None
    """All joints of the robot."""
    position_error_m: float = 0.0
    orientation_error_rad: float = 0.0


@attrs.frozen
class FkAnswer:
    """Answer of `/compute_fk`."""

    code: PlanCode
    message: str = ""
    poses: tuple[PoseStamped, ...] = ()
    """One for each link."""


@attrs.frozen
class ObjectSummary:
    """An object of the world, without its shape's numbers."""

    shape: str
    pose: Pose
    """In the base frame, or in the frame of `link`."""
    link: str | None
    may_touch: tuple[str, ...]


@attrs.frozen(eq=False)
class PlanningScene:
    """Answer of `/get_planning_scene`: the robot and what is around it."""

    robot: str
    joint_state: JointState
    """Present positions."""
    groups: Mapping[str, tuple[str, ...]]
    poses: tuple[str, ...]
    """Names of poses."""
    tip: str
    """Name of the tool centre point."""
    links: tuple[str, ...]
    objects: Mapping[str, ObjectSummary]


@documented
@attrs.frozen(eq=False)
class Execute:
    """A request to `/execute_trajectory`: the keys of a trajectory_msgs/msg/JointTrajectory."""

    joint_names: tuple[str, ...] = option(help="the joints of the trajectory")
    points: tuple[JointTrajectoryPoint, ...] = option(help="positions, and velocities and accelerations if wanted")
    header: Header = option(Header(), help="is not read: a trajectory begins when it is executed")

    def __attrs_post_init__(self) -> None:
        if not self.joint_names or not self.points:
            raise ValueError("a trajectory needs joint_names and points, neither of them empty")

    def trajectory(self) -> JointTrajectory:
        """The trajectory."""
        return JointTrajectory(Header(), self.joint_names, self.points)


def any_goal(goals: tuple[GoalOptions, ...]) -> Goal:
    """One goal as it is, several as alternatives.

    Raises:
        PlanningError: without goals.
    """
    if not goals:
        raise PlanningError("a request needs at least one goal", PlanCode.INVALID_GOAL_CONSTRAINTS)
    return goals[0].goal() if len(goals) == 1 else AnyGoal(tuple(each.goal() for each in goals))

"""The keys of a goal, common to task files, requests to services and, as `key=value`, text."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Literal, get_args

import attrs
import numpy as np
from ibrobot_kinematics import PathConstraints
from ibrobot_kinematics.poses import homogeneous, matrix, pose
from ibrobot_kinematics.rotations import from_quaternion, from_rpy
from ibrobot_kinematics.run_frames import BASE_FRAMES

from ibrobot_core.api import PlanCode, PlanningError, Pose, Vector, Vector3, documented, option
from ibrobot_planning.goals.errors import invalid_goal
from ibrobot_planning.planner import (
    ConstrainedGoal,
    JointGoal,
    LinearGoal,
    NamedGoal,
    OrientationPolicy,
    PoseGoal,
    PositionGoal,
)
from ibrobot_planning.world.bounds import FURTHEST
from ibrobot_planning.world.objects import World

type Triple = tuple[float, float, float]

DIRECTIONS: Mapping[str, Triple] = {"down": (0.0, 0.0, -1.0), "up": (0.0, 0.0, 1.0)}
POLICIES: tuple[str, ...] = get_args(OrientationPolicy)
LEAST_SCALING = 0.01
"""Least fraction of the velocity and acceleration limits that a goal may ask for."""
_NEARLY_ONE = 1e-3
"""Allowed deviation of a quaternion's length from 1."""
_UPRIGHT = math.cos(math.radians(45.0))


def exactly_one(what: str, present: Mapping[str, bool]) -> None:
    """Check that exactly one of several keys is present.

    Raises:
        ValueError: for none, or more than one.
    """
    names = [name for name, is_present in present.items() if is_present]
    if len(names) != 1:
        fault = f"{' and '.join(names)} exclude each other" if names else "there is none"
        raise ValueError(f"{what} has one of {', '.join(present)}; {fault}")


@documented
@attrs.frozen
class GoalOptions:
    """A goal of the arm: a named pose, joints, or a position of the tool, with an optional direction or orientation."""

    pose: str | None = option(None, help="a pose of the robot YAML or the SRDF")
    joints: Mapping[str, float] = option(factory=dict, unit="rad", help="joint -> position; the others stay")
    xyz: tuple[float, float, float] | None = option(
        None, unit="m", help="position of the tool, in the base frame or relative to `object`"
    )
    object: str | None = option(
        None, help="object of the world: position, axis and orientation are relative to its centre and its turn about z"
    )
    relative: bool = option(False, help="whether `xyz` is added to the tool's present position, in the base frame")
    axis: tuple[float, float, float] | Literal["down", "up"] | None = option(
        None, help="direction of the tool's z axis, e.g. [0, 0, -1]"
    )
    rpy: tuple[float, float, float] | None = option(
        None, unit="rad", help="orientation of the tool: roll, pitch, yaw about the fixed axes"
    )
    quaternion: tuple[float, float, float, float] | None = option(None, help="x, y, z, w, in place of rpy")
    beyond_reach: OrientationPolicy = option("refuse", help="how to treat an orientation that the arm cannot take")
    joint_tolerance: float = option(0.0, unit="rad", ge=0, help="allowed deviation if the joints' goal is blocked")
    position_tolerance: float = option(0.001, unit="m", gt=0, help="allowed distance from the position")
    angle_tolerance: float = option(0.01, unit="rad", gt=0, help="allowed angle from the axis or orientation")
    path_constraints: PathConstraints | None = option(None, help="what holds on the whole way, e.g. {upright: 0.17}")

    def __attrs_post_init__(self) -> None:
        exactly_one("a goal", self.kinds())
        turns = {"axis": self.axis, "rpy": self.rpy, "quaternion": self.quaternion}
        turned = [name for name, value in turns.items() if value is not None]
        if turned and not self.of_tool:
            raise ValueError(f"{turned[0]} needs a position: xyz or object")
        if len(turned) > 1:
            raise ValueError(f"{' and '.join(turned)} exclude each other")
        if self.relative and (self.xyz is None or self.object is not None):
            raise ValueError("relative needs xyz, and no object")
        if self.beyond_reach != "refuse" and turned not in (["rpy"], ["quaternion"]):
            raise ValueError("beyond_reach needs an orientation: rpy or quaternion")
        axis = None if isinstance(self.axis, str) else self.axis
        numbers = {"xyz": self.xyz, "rpy": self.rpy, "axis": axis, "joints": tuple(self.joints.values())}
        for name, values in numbers.items():
            if not all(abs(value) <= FURTHEST for value in values or ()):  # NaN fails it, too
                raise ValueError(f"{name} must be numbers from -{FURTHEST:g} to {FURTHEST:g}, got {list(values or ())}")
        if self.axis is not None and not isinstance(self.axis, str) and not any(self.axis):
            raise ValueError("axis has no length; give a direction, e.g. down, or 0, 0, -1")
        # Written so that NaN fails it.
        if self.quaternion is not None and not abs(math.hypot(*self.quaternion) - 1) <= _NEARLY_ONE:
            length = math.hypot(*self.quaternion)
            raise ValueError(f"quaternion has length {length:.3g}, must be 1; the order is x, y, z, w")

    def kinds(self) -> dict[str, bool]:
        """Kind of goal -> whether it is this kind."""
        return {"pose": self.pose is not None, "joints": bool(self.joints), "xyz or object": self.of_tool}

    @property
    def of_tool(self) -> bool:
        """Whether it is a position of the tool."""
        return self.xyz is not None or self.object is not None

    @property
    def text(self) -> str:
        """The goal in a few words."""
        kept = "" if self.path_constraints is None else f" {self.path_constraints.text}"
        if self.pose is not None:
            return f"{self.pose}{kept}"
        if self.joints:
            return ", ".join(f"{joint}={value:g}" for joint, value in self.joints.items()) + kept
        where = ", ".join(f"{value:g}" for value in self.xyz or (0.0, 0.0, 0.0))
        of = " from here" if self.relative else f" from {self.object}" if self.object is not None else ""
        return f"({where}) m{of}{kept}"

    def goal(
        self, world: World, tool: Vector | None = None
    ) -> JointGoal | NamedGoal | PositionGoal | PoseGoal | ConstrainedGoal:
        """The goal, in the form that planners take, with its path constraints.

        Args:
            world: the objects that it may refer to.
            tool: present position of the tool [m], shape (3,), for a relative goal.

        Raises:
            PlanningError: for an unknown object, or a relative goal without a position of the tool.
        """
        goal: JointGoal | NamedGoal | PositionGoal | PoseGoal
        if self.pose is not None:
            goal = NamedGoal(self.pose)
        elif self.joints:
            goal = JointGoal(tuple(self.joints), np.array(list(self.joints.values())), self.joint_tolerance)
        else:
            goal = self.tool_goal(world, tool)
        return goal if self.path_constraints is None else ConstrainedGoal(goal, self.path_constraints)

    def tool_goal(self, world: World, tool: Vector | None = None) -> PositionGoal | PoseGoal:
        """The position or pose of the tool, without constraints; arguments and errors are those of `goal`.

        Raises:
            PlanningError: also for other kinds of goals.
        """
        if not self.of_tool:
            raise invalid_goal(f"goal {self.text} is not a position of the tool: give xyz")
        frame = np.eye(4) if self.object is None else upright(object_pose(world, self.object))
        if self.relative:
            if tool is None:
                raise invalid_goal("a relative goal needs a model of the robot: robot.description.mjcf")
            frame[:3, 3] = tool
        position = frame @ (*(self.xyz or (0.0, 0.0, 0.0)), 1.0)
        if self.rpy is None and self.quaternion is None:
            axis = None
            if self.axis is not None:
                direction = DIRECTIONS[self.axis] if isinstance(self.axis, str) else self.axis
                axis = Vector3(*(frame[:3, :3] @ direction).tolist())
            return PositionGoal(Vector3(*position[:3].tolist()), axis, self.position_tolerance, self.angle_tolerance)
        turn = from_rpy(*self.rpy) if self.rpy is not None else from_quaternion(self.quaternion or ())
        placed = pose(homogeneous(frame[:3, :3] @ turn, position[:3]))
        return PoseGoal(placed, self.position_tolerance, self.angle_tolerance, self.beyond_reach)


def line_goal(
    waypoints: Sequence[GoalOptions], least_fraction: float, constraints: PathConstraints | None,
    world: World, tool: Vector | None = None,
) -> LinearGoal | ConstrainedGoal:  # fmt: skip
    """Straight lines of the tool through waypoints, with path constraints for all of them.

    Raises:
        PlanningError: without waypoints, or as `GoalOptions.tool_goal`.
    """
    if not waypoints:
        raise invalid_goal("a straight path needs at least one waypoint")
    line = LinearGoal(tuple(each.tool_goal(world, tool) for each in waypoints), least_fraction)
    return line if constraints is None else ConstrainedGoal(line, constraints)


def check_waypoints(key: str, waypoints: Sequence[GoalOptions]) -> None:
    """Check that waypoints are positions, and leave path constraints to their line.

    Args:
        key: their key, for the error.
        waypoints: the ends of straight lines.

    Raises:
        ValueError: for the first that is not, or does not.
    """
    for i, each in enumerate(waypoints):
        if not each.of_tool:
            raise ValueError(f"{key}.{i}: a straight line goes to a position: xyz or object")
        if each.path_constraints is not None:
            raise ValueError(f"{key}.{i}: path_constraints hold on the whole line: give them beside {key}")


def upright(thing: Pose) -> Vector:
    """The frame of an object in which goals are given, shape (4, 4).

    Its origin is that of the object. Its z axis points up, its x axis along the horizontal part of the object's x axis,
    or of the y axis if the x axis is upright.
    """
    placed = matrix(thing)
    across = placed[:3, 0] if abs(placed[2, 0]) < _UPRIGHT else placed[:3, 1]
    placed[:3, :3] = from_rpy(0.0, 0.0, math.atan2(across[1], across[0]))
    return placed


def object_pose(world: World, name: str) -> Pose:
    """The pose of an object.

    Raises:
        PlanningError: for an unknown object, or one that a link carries.
    """
    thing = world.named(name)
    if thing.link is not None:
        raise PlanningError(
            f"object {name!r} is attached to {thing.link}, and moves with it: release it first",
            PlanCode.INVALID_OBJECT_NAME,
        )
    return thing.pose


def check_frame(frame: str) -> None:
    """Check that a frame is that of the base, which is also meant by an empty name.

    Raises:
        PlanningError: if it is not.
    """
    if frame not in BASE_FRAMES:
        names = ", ".join(filter(None, BASE_FRAMES))
        raise PlanningError(f"frame {frame!r} is not the base; it is called {names}", PlanCode.FRAME_TRANSFORM_FAILURE)


def scaling_fault(name: str, scaling: float) -> str:
    """Why a fraction of the limits is invalid; empty if it is valid.

    Args:
        name: its name, e.g. `velocity_scaling`.
        scaling: the fraction.
    """
    if LEAST_SCALING <= scaling <= 1:  # false for NaN
        return ""
    return f"{name} is {scaling}, must be from {LEAST_SCALING} to 1"

"""Goals as text: for `--goal` and for the services that take goals."""

from __future__ import annotations

import math
from typing import get_args

import attrs
from ibrobot_kinematics.poses import orientation
from ibrobot_kinematics.rotations import from_rpy

from ibrobot_core.api import (
    AnyGoal,
    Goal,
    JointGoal,
    JointTrajectory,
    LinearGoal,
    NamedGoal,
    OrientationPolicy,
    PlanCode,
    PlanningError,
    Pose,
    PoseGoal,
    PositionGoal,
    Quaternion,
    Robot,
    Vector3,
)
from ibrobot_planning.goals.named_poses import named_pose

LEAST_SCALING = 0.01
"""Least fraction of the limits of velocity and acceleration that a goal may ask for."""
POLICIES: tuple[str, ...] = get_args(OrientationPolicy)
_DIRECTIONS = {"down": Vector3(0.0, 0.0, -1.0), "up": Vector3(0.0, 0.0, 1.0)}
_SIZES = {"xyz": 3, "axis": 3, "rpy": 3, "quat": 4}
"""Keys with lists of numbers -> the number of values."""
_KEYS = (*_SIZES, "beyond_reach")
_NEARLY_ONE = 1e-3
"""Allowed deviation of a quaternion's length from 1."""


@attrs.frozen
class Target:
    """A goal, divided among the executors of a mode."""

    text: str
    tool: Goal | None = None
    """The goal to plan for an executor of trajectories."""
    joints: dict[str, float] = attrs.field(factory=dict)
    """Joint -> position [rad]."""
    velocity_scaling: float = 1.0
    acceleration_scaling: float = 1.0
    trajectory: JointTrajectory | None = None
    """A trajectory to follow as it is, in place of a goal."""


def target(goal: str | Goal | Target, robot: Robot, velocity_scaling: float = 1.0) -> Target:
    """Divide a goal among the executors.

    Args:
        goal: a goal, a `Target`, or text: a pose's name; `joint=radians,joint=radians`; `xyz=X,Y,Z` [m], alone, with
            `axis=X,Y,Z` (or `down`, `up`), with `rpy=R,P,Y` [rad] or with `quat=X,Y,Z,W`. Joints that do not move the
            tool may stand beside a position.
        robot: the robot.
        velocity_scaling: fraction of the velocity limits, from `LEAST_SCALING` to 1.

    Raises:
        PlanningError: for a goal that makes no sense for this robot.
    """
    if isinstance(goal, Target):
        return goal
    if fault := scaling_fault("velocity_scaling", velocity_scaling):
        raise _invalid(fault)
    if isinstance(goal, str):
        try:
            tool, joints = _parsed(goal.strip(), robot)
        except PlanningError as error:
            raise _invalid(f"goal {goal!r}: {error}") from None
        return Target(goal, tool, joints, velocity_scaling)
    if isinstance(goal, NamedGoal):
        return target(goal.name, robot, velocity_scaling)
    if isinstance(goal, JointGoal) and not goal.tolerance:
        positions = dict(zip(goal.joints, map(float, goal.positions), strict=False))
        if len(positions) != len(goal.joints) or len(goal.positions) != len(goal.joints):
            raise _invalid(f"goal has {len(goal.joints)} joints and {len(goal.positions)} positions, each joint once")
        for joint, value in positions.items():
            _check_joint(joint, robot)
            if not math.isfinite(value):
                raise _invalid(f"goal of joint {joint} is {value}, must be an angle in radians")
        return Target(
            ", ".join(f"{joint}={value:g}" for joint, value in positions.items()), None, positions, velocity_scaling
        )
    for joint in goal.joints if isinstance(goal, JointGoal) else ():
        _check_joint(joint, robot)
    if isinstance(goal, JointGoal | PositionGoal | PoseGoal | AnyGoal | LinearGoal):
        return Target(_described(goal), goal, velocity_scaling=velocity_scaling)
    raise _invalid(
        "a goal is a text such as 'home' or 'xyz=0.2,0.0,0.1', or a goal of ibrobot_core.api;"
        f" got {type(goal).__name__}"
    )


def scaling_fault(name: str, scaling: float) -> str:
    """Why a fraction of the limits cannot be planned with; empty if it can.

    Args:
        name: its name, e.g. `velocity_scaling`.
        scaling: the fraction.
    """
    if LEAST_SCALING <= scaling <= 1:  # NaN is no such number
        return ""
    return f"{name} is {scaling}, must be from {LEAST_SCALING} to 1"


def _described(goal: Goal) -> str:
    match goal:
        case JointGoal(joints=joints, positions=positions):
            return ", ".join(f"{joint}={value:g}" for joint, value in zip(joints, positions.tolist(), strict=False))
        case PositionGoal(position=p):
            return f"position {p.x:g}, {p.y:g}, {p.z:g}"
        case PoseGoal(pose=Pose(position=p)):
            return f"pose at {p.x:g}, {p.y:g}, {p.z:g}"
        case AnyGoal(goals=goals) if goals:
            return _described(goals[0])
        case LinearGoal(waypoints=waypoints):
            return f"line through {len(waypoints)} waypoints"
        case _:
            return type(goal).__name__


def _parsed(text: str, robot: Robot) -> tuple[PositionGoal | PoseGoal | None, dict[str, float]]:
    if not text:
        raise _invalid("a goal is a pose's name, joints, e.g. wrist_flex=0.5, or a position, e.g. xyz=0.2,0.0,0.1")
    if "=" not in text:
        return None, _named(text, robot)
    words = _words(text)
    joints = {key: _angle(key, values, robot) for key, values in words.items() if key not in _KEYS}
    given = {key: values for key, values in words.items() if key in _KEYS}
    if given and "xyz" not in given:
        raise _invalid(f"{next(iter(given))} needs a position, e.g. xyz=0.2,0.0,0.1")
    return _tool_goal(given) if given else None, joints


def _named(name: str, robot: Robot) -> dict[str, float]:
    try:
        return named_pose(robot, name)
    except PlanningError as error:
        hint = "; or give joints, e.g. wrist_flex=0.5, or a position, e.g. xyz=0.2,0.0,0.1"
        raise _invalid(f"{error}{hint}") from None


def _words(text: str) -> dict[str, list[str]]:
    """Key -> its values, of `key=value,value key=value`."""
    words: dict[str, list[str]] = {}
    key = ""
    for word in text.replace(",", " ").replace("=", "= ").split():
        if word.endswith("="):
            key = word[:-1]
            if key in words:
                raise _invalid(f"{key} is given twice")
            words[key] = []
        elif not key:
            raise _invalid(f"{word!r} is neither a joint nor {', '.join(_KEYS)}, each followed by = and its value")
        else:
            words[key].append(word)
    return words


def _angle(joint: str, values: list[str], robot: Robot) -> float:
    _check_joint(joint, robot)
    if len(values) != 1:
        raise _invalid(f"joint {joint} takes one angle, got {len(values)}")
    try:
        value = float(values[0])
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise _invalid(f"{values[0]!r} is not an angle in radians")
    return value


def _check_joint(joint: str, robot: Robot) -> None:
    if joint not in robot.joint_names:
        raise _invalid(f"no joint {joint!r}; the joints are: {', '.join(robot.joint_names)}")


def _numbers(key: str, values: list[str]) -> list[float]:
    if len(values) != _SIZES[key]:
        raise _invalid(f"{key} takes {_SIZES[key]} numbers, got {len(values)}")
    numbers = []
    for value in values:
        try:
            number = float(value)
        except ValueError:
            number = math.nan
        if not math.isfinite(number):
            raise _invalid(f"{key}: {value!r} is not a finite number")
        numbers.append(number)
    return numbers


def _tool_goal(given: dict[str, list[str]]) -> PositionGoal | PoseGoal:
    position = Vector3(*_numbers("xyz", given["xyz"]))
    turned = [key for key in ("axis", "rpy", "quat") if key in given]
    if len(turned) > 1:
        raise _invalid(f"{turned[0]} and {turned[1]} exclude each other")
    if "beyond_reach" in given and turned not in (["rpy"], ["quat"]):
        raise _invalid("beyond_reach needs an orientation: rpy or quat")
    if not turned:
        return PositionGoal(position)
    key, values = turned[0], given[turned[0]]
    if key == "axis":
        axis = _DIRECTIONS.get(values[0]) if len(values) == 1 else None
        if len(values) == 1 and axis is None:
            raise _invalid(f"axis is {' or '.join(_DIRECTIONS)} or 3 numbers, got {values[0]!r}")
        axis = axis or Vector3(*_numbers("axis", values))
        if not any((axis.x, axis.y, axis.z)):
            raise _invalid("axis has no length; give a direction, e.g. axis=0,0,-1 for down")
        return PositionGoal(position, axis)
    numbers = _numbers(key, values)
    if key == "quat" and abs(math.hypot(*numbers) - 1) > _NEARLY_ONE:
        raise _invalid(f"quat has length {math.hypot(*numbers):.3g}, must be 1; the order is x, y, z, w")
    turn = Quaternion(*numbers) if key == "quat" else orientation(from_rpy(*numbers))
    return PoseGoal(Pose(position, turn), beyond_reach=_policy(given.get("beyond_reach", ["refuse"])))


def _policy(values: list[str]) -> OrientationPolicy:
    for policy in get_args(OrientationPolicy):
        if values == [policy]:
            return policy  # type: ignore[no-any-return]
    raise _invalid(f"beyond_reach is one of {', '.join(POLICIES)}; got {' '.join(values)!r}")


def _invalid(message: str) -> PlanningError:
    return PlanningError(message, PlanCode.INVALID_GOAL_CONSTRAINTS)

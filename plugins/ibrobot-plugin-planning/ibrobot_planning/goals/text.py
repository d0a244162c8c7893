"""Goals as text, e.g. `xyz=0.2,0.0,0.1 axis=down`, and their division among executors."""

from __future__ import annotations

import math
from typing import Any

import attrs
from ibrobot_kinematics import PathConstraints
from ibrobot_kinematics.path_constraints import AXES, CONSTRAINT_KEYS

from ibrobot_core.api import JointTrajectory, PlanningError, Pose, Robot
from ibrobot_planning.goals.errors import invalid_goal
from ibrobot_planning.goals.grammar import DIRECTIONS, POLICIES, GoalOptions, scaling_fault
from ibrobot_planning.goals.joints import named_pose
from ibrobot_planning.planner import (
    AnyGoal,
    ConstrainedGoal,
    Goal,
    JointGoal,
    LinearGoal,
    NamedGoal,
    PoseGoal,
    PositionGoal,
)
from ibrobot_planning.world.objects import World

_SIZES = {
    "xyz": 3, "axis": 3, "rpy": 3, "quaternion": 4, "upright": 1, "upright_axis": 3, "region": 6, "view": 3,
    "view_angle": 1, "view_axis": 3, "view_from": 3,
}  # fmt: skip
"""Keys with numbers -> how many."""
_WORDS = {"beyond_reach": POLICIES, "axis": tuple(DIRECTIONS), "upright_axis": AXES, "view_axis": AXES}
"""Keys with words -> the words."""
_KEYS = (*dict.fromkeys((*_SIZES, *_WORDS)),)
_LONGEST = 1000
"""Characters of a goal, as of a text in a request to a service."""
_EXAMPLES = "joints, e.g. wrist_flex=0.5, or a position, e.g. xyz=0.2,0.0,0.1"


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
    """A trajectory to follow unchanged, in place of a goal."""
    constraints: PathConstraints | None = None
    """Path constraints of motions to `joints`; those of `tool` are in it."""


def target(goal: str | Goal | Target, robot: Robot, velocity_scaling: float = 1.0) -> Target:
    """Divide a goal among the executors.

    Args:
        goal: a goal, a `Target`, or text: a pose's name; `joint=radians,joint=radians`; `xyz=X,Y,Z` [m], alone or with
            other keys of `GoalOptions`. Joints that do not move the tool may accompany a position. The keys of
            `PathConstraints` may follow each of them.
        robot: the robot.
        velocity_scaling: fraction of the velocity limits, from `LEAST_SCALING` to 1.

    Raises:
        PlanningError: for a goal that is invalid for this robot.
    """
    if isinstance(goal, Target):
        return goal
    if fault := scaling_fault("velocity_scaling", velocity_scaling):
        raise invalid_goal(fault)
    if isinstance(goal, NamedGoal):
        goal = goal.name
    if isinstance(goal, str):
        if len(goal) > _LONGEST:
            raise invalid_goal(f"goal has {len(goal)} characters, at most {_LONGEST} are read")
        try:
            tool, joints, constraints = _parsed(goal.strip(), robot)
        except (PlanningError, ValueError) as error:
            raise invalid_goal(f"goal {goal!r}: {error}") from None
        return Target(goal, tool, joints, velocity_scaling, constraints=constraints)
    if not isinstance(goal, JointGoal | PositionGoal | PoseGoal | AnyGoal | LinearGoal | ConstrainedGoal):
        raise invalid_goal(
            "a goal is a text such as 'home' or 'xyz=0.2,0.0,0.1', or a goal of ibrobot_core.api;"
            f" got {type(goal).__name__}"
        )
    if isinstance(goal, JointGoal):
        return _joint_target(goal, robot, velocity_scaling)
    if isinstance(goal, ConstrainedGoal) and isinstance(goal.goal, JointGoal | NamedGoal):
        unconstrained = target(goal.goal, robot, velocity_scaling)
        if unconstrained.tool is None:
            return attrs.evolve(unconstrained, constraints=goal.constraints)
    return Target(_described(goal), goal, velocity_scaling=velocity_scaling)


def _joint_target(goal: JointGoal, robot: Robot, velocity_scaling: float) -> Target:
    for joint in goal.joints:
        _check_joint(joint, robot)
    if goal.tolerance:
        return Target(_described(goal), goal, velocity_scaling=velocity_scaling)
    positions = dict(zip(goal.joints, map(float, goal.positions), strict=False))
    if len(positions) != len(goal.joints) or len(goal.positions) != len(goal.joints):
        counts = f"joints: {len(goal.joints)}, positions: {len(goal.positions)}"
        raise invalid_goal(f"goal has {counts}; must have each joint once, with a position")
    for joint, value in positions.items():
        if not math.isfinite(value):
            raise invalid_goal(f"goal of joint {joint} is {value}, must be an angle in radians")
    return Target(_described(goal), None, positions, velocity_scaling)


def _described(goal: Goal) -> str:
    words = type(goal).__name__
    match goal:
        case JointGoal(joints=joints, positions=positions):
            words = ", ".join(f"{joint}={value:g}" for joint, value in zip(joints, positions.tolist(), strict=False))
        case PositionGoal(position=p):
            words = f"position {p.x:g}, {p.y:g}, {p.z:g}"
        case PoseGoal(pose=Pose(position=p)):
            words = f"pose at {p.x:g}, {p.y:g}, {p.z:g}"
        case AnyGoal(goals=goals) if goals:
            words = _described(goals[0])
        case LinearGoal(waypoints=waypoints):
            words = f"line through {len(waypoints)} waypoint{'' if len(waypoints) == 1 else 's'}"
        case ConstrainedGoal(goal=constrained, constraints=constraints):
            words = f"{_described(constrained)} {constraints.text}"
    return words


def _parsed(text: str, robot: Robot) -> tuple[Goal | None, dict[str, float], PathConstraints | None]:
    """The goal of the tool, the positions of joints, and path constraints of a motion to joints."""
    if not text:
        raise invalid_goal(f"a goal is a pose's name, {_EXAMPLES}")
    name, values_by_key = text, {}
    if "=" in text:
        name = text.partition("=")[0].rstrip().rpartition(" ")[0].strip(" ,")
        values_by_key = _split(text.removeprefix(name))
        if name and not set(values_by_key) <= set(CONSTRAINT_KEYS):
            values_by_key = _split(text)  # refuses the name
    joints = {key: _angle(key, values, robot) for key, values in values_by_key.items() if key not in _KEYS}
    keys = {key: _value(key, values) for key, values in values_by_key.items() if key in _KEYS}
    constraints = {key: keys.pop(key) for key in CONSTRAINT_KEYS if key in keys}
    if name:
        try:
            joints = named_pose(robot, name)
        except PlanningError as error:
            raise invalid_goal(f"{error}; or give {_EXAMPLES}") from None
    if keys and "xyz" not in keys:
        raise invalid_goal(f"{next(iter(keys))} needs a position, e.g. xyz=0.2,0.0,0.1")
    if constraints and not (keys or joints):
        raise invalid_goal(f"{next(iter(constraints))} holds on the way to a goal: give a pose's name, {_EXAMPLES}")
    path = PathConstraints(**constraints) if constraints else None
    if not keys:
        return None, joints, path
    return GoalOptions(**keys, path_constraints=path).goal(World()), joints, None


def _split(text: str) -> dict[str, list[str]]:
    """Key -> its values, from `key=value,value key=value`."""
    values_by_key: dict[str, list[str]] = {}
    key = ""
    for word in text.replace(",", " ").replace("=", "= ").split():
        if word.endswith("="):
            key = word[:-1]
            if key in values_by_key:
                raise invalid_goal(f"{key} is given twice")
            values_by_key[key] = []
        elif not key:
            raise invalid_goal(f"{word!r} is neither a joint nor {', '.join(_KEYS)}, each followed by = and its value")
        else:
            values_by_key[key].append(word)
    return values_by_key


def _value(key: str, words: list[str]) -> Any:
    """The value of a key of `GoalOptions` or `PathConstraints`."""
    word = words[0] if len(words) == 1 else ""
    number, choices = _SIZES.get(key, 0), _WORDS.get(key, ())
    if word in choices:
        return word
    if not number:
        raise invalid_goal(f"{key} is one of {', '.join(choices)}; got {' '.join(words)!r}")
    if choices and word:
        raise invalid_goal(f"{key} is {' or '.join(choices)} or {number} numbers, got {word!r}")
    if len(words) != number:
        raise invalid_goal(f"{key} takes {number} number{'s' if number > 1 else ''}, got {len(words)}")
    values = tuple(_number(each, f"{key}: {each!r} is not a finite number") for each in words)
    value = values if number > 1 else values[0]
    field = (attrs.fields_dict(GoalOptions) | attrs.fields_dict(PathConstraints))[key]
    if field.validator is not None:
        try:
            field.validator(None, field, value)
        except ValueError as error:
            raise invalid_goal(f"{key}: {error}") from None
    return value


def _angle(joint: str, words: list[str], robot: Robot) -> float:
    if joint == "quat" and joint not in robot.joint_names:
        raise invalid_goal("quat is called quaternion")
    _check_joint(joint, robot)
    if len(words) != 1:
        raise invalid_goal(f"joint {joint} takes one angle, got {len(words)}")
    return _number(words[0], f"{words[0]!r} is not an angle in radians")


def _number(word: str, fault: str) -> float:
    try:
        number = float(word)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise invalid_goal(fault)
    return number


def _check_joint(joint: str, robot: Robot) -> None:
    if joint not in robot.joint_names:
        raise invalid_goal(f"no joint {joint!r}; the joints are: {', '.join(robot.joint_names)}")

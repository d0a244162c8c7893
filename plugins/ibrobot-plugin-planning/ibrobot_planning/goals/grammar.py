"""How users write goals: by keys in task files and requests to services, or as text, e.g. `xyz=0.2,0.0,0.1 axis=down`.

`target` divides a goal of any form among the executors of a mode.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal, get_args

import attrs
import numpy as np
from ibrobot_kinematics import PathConstraints
from ibrobot_kinematics.errors import KinematicsError
from ibrobot_kinematics.path_constraints import AXES, CONSTRAINT_KEYS
from ibrobot_kinematics.poses import homogeneous, matrix, pose
from ibrobot_kinematics.rotations import from_quaternion, from_rpy
from ibrobot_kinematics.run_frames import BASE_FRAMES
from ibrobot_kinematics.srdf import GroupState, read_srdf
from ibrobot_kinematics.urdf import read_urdf

from ibrobot_core.api import (
    JointTrajectory,
    PlanCode,
    PlanningError,
    Pose,
    Robot,
    Vector,
    Vector3,
    documented,
    option,
)
from ibrobot_planning.planner import (
    AnyGoal,
    ConstrainedGoal,
    Goal,
    JointGoal,
    LinearGoal,
    NamedGoal,
    OrientationPolicy,
    PoseGoal,
    PositionGoal,
    invalid_goal,
    scaling_fault,
)
from ibrobot_planning.world.bounds import FURTHEST
from ibrobot_planning.world.objects import World

type Triple = tuple[float, float, float]

DIRECTIONS: Mapping[str, Triple] = {"down": (0.0, 0.0, -1.0), "up": (0.0, 0.0, 1.0)}
POLICIES: tuple[str, ...] = get_args(OrientationPolicy)
_NEARLY_ONE = 1e-3
"""Allowed deviation of a quaternion's length from 1."""
_UPRIGHT = math.cos(math.radians(45.0))
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


def pose_names(robot: Robot) -> list[str]:
    """The names of a robot's poses.

    Raises:
        PlanningError: if its URDF or SRDF cannot be read.
    """
    return list(dict.fromkeys([*robot.description.poses, *(state.name for state in _group_states(robot))]))


def named_pose(robot: Robot, name: str) -> dict[str, float]:
    """Joint -> position [rad], from the robot YAML, or else from all group states of this name in the SRDF.

    Raises:
        PlanningError: for an unknown name, group states that contradict each other, or files that cannot be read.
    """
    if name in robot.description.poses:
        return dict(zip(robot.joint_names, robot.pose(name).tolist(), strict=True))
    states = [state for state in _group_states(robot) if state.name == name]
    if not states:
        raise invalid_goal(f"no pose {name!r}; the poses are: {', '.join(pose_names(robot)) or 'none'}")
    positions: dict[str, float] = {}
    for state in states:
        for joint, value in state.positions.items():
            if joint not in robot.joint_names:
                continue
            if positions.setdefault(joint, value) != value:
                groups = ", ".join(each.group for each in states)
                raise invalid_goal(f"pose {name!r} of the SRDF has two positions of joint {joint}, in groups {groups}")
    return positions


def _group_states(robot: Robot) -> tuple[GroupState, ...]:
    description = robot.description
    if description.srdf is None or description.urdf is None:
        return ()
    try:
        return read_srdf(description.srdf, read_urdf(description.urdf)).states
    except KinematicsError as error:
        raise invalid_goal(str(error)) from None


def without_names(goal: Goal, robot: Robot, joints: Sequence[str]) -> Goal:
    """The goal, with named poses replaced by the positions of `joints`.

    Raises:
        PlanningError: as `named_pose`.
    """
    if isinstance(goal, AnyGoal):
        return AnyGoal(tuple(without_names(each, robot, joints) for each in goal.goals))  # type: ignore[misc]
    if isinstance(goal, ConstrainedGoal):
        return ConstrainedGoal(without_names(goal.goal, robot, joints), goal.constraints)  # type: ignore[arg-type]
    if not isinstance(goal, NamedGoal):
        return goal
    positions = {joint: value for joint, value in named_pose(robot, goal.name).items() if joint in joints}
    return JointGoal(tuple(positions), np.array(list(positions.values())))


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

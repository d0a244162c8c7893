"""Goals of a task file as goals of planners."""

from __future__ import annotations

import math
from collections.abc import Collection

import numpy as np
from ibrobot_kinematics.poses import matrix, pose
from ibrobot_kinematics.rotations import from_quaternion, from_rpy

from ibrobot_core.api import (
    AnyGoal,
    Goal,
    JointGoal,
    LinearGoal,
    PlanCode,
    PlanningError,
    Pose,
    PoseGoal,
    PositionGoal,
    Robot,
    Vector,
    Vector3,
)
from ibrobot_planning.goals.named_poses import named_pose
from ibrobot_planning.goals.text import Target
from ibrobot_planning.tasks.format import GoalOptions, MoveStep
from ibrobot_planning.world.objects import World

_DIRECTIONS = {"down": (0.0, 0.0, -1.0), "up": (0.0, 0.0, 1.0)}
_UPRIGHT = math.cos(math.radians(45.0))


def move_target(step: MoveStep, robot: Robot, arm: Collection[str], world: World, tool: Vector | None = None) -> Target:
    """The goal of a step.

    Args:
        step: the step.
        robot: the robot.
        arm: the joints that a motion may move; those of a named pose are limited to them.
        world: the objects that goals refer to, where they are now.
        tool: present position of the tool [m], shape (3,), for relative goals.

    Raises:
        PlanningError: for an unknown pose or object.
    """
    if step.any:
        goal: Goal = AnyGoal(tuple(_simple(each, robot, arm, world, tool) for each in step.any))
        return Target(_text(step.any[0]) + f" or {len(step.any) - 1} others", goal, velocity_scaling=step.speed)
    if step.line:
        goal = LinearGoal(tuple(_of_tool(each, world, tool) for each in step.line), step.least_fraction)
        return Target(f"line to {_text(step.line[-1])}", goal, velocity_scaling=step.speed)
    if step.of_tool:
        return Target(_text(step), _of_tool(step, world, tool), velocity_scaling=step.speed)
    joints = _joints(step, robot, arm)
    return Target(_text(step), None, joints, velocity_scaling=step.speed)


def upright(thing: Pose) -> Vector:
    """The frame of an object in which goals are given, shape (4, 4).

    Its origin is that of the object, its z axis points up, and its x axis along the horizontal part of the object's x
    axis, or of its y axis where the x axis stands upright.
    """
    placed = matrix(thing)
    across = placed[:3, 0] if abs(placed[2, 0]) < _UPRIGHT else placed[:3, 1]
    placed[:3, :3] = from_rpy(0.0, 0.0, math.atan2(across[1], across[0]))
    return placed


def object_pose(world: World, name: str) -> Pose:
    """Where an object stands.

    Raises:
        PlanningError: for an unknown object, or one that a link carries.
    """
    thing = world.named(name)
    if thing.link is not None:
        raise PlanningError(
            f"object {name!r} is attached to {thing.link}, and moves with it: release it before a goal refers to it",
            PlanCode.INVALID_OBJECT_NAME,
        )
    return thing.pose


def _simple(
    goal: GoalOptions, robot: Robot, arm: Collection[str], world: World, tool: Vector | None
) -> JointGoal | PositionGoal | PoseGoal:
    if goal.of_tool:
        return _of_tool(goal, world, tool)
    joints = _joints(goal, robot, arm)
    return JointGoal(tuple(joints), np.array(list(joints.values())))


def _joints(goal: GoalOptions, robot: Robot, arm: Collection[str]) -> dict[str, float]:
    if goal.pose is None:
        return dict(goal.joints)
    return {joint: value for joint, value in named_pose(robot, goal.pose).items() if joint in arm}


def _of_tool(goal: GoalOptions, world: World, tool: Vector | None) -> PositionGoal | PoseGoal:
    frame = np.eye(4) if goal.object is None else upright(object_pose(world, goal.object))
    if goal.relative:
        assert tool is not None
        frame[:3, 3] = tool
    placed = np.eye(4)
    placed[:3, 3] = goal.xyz or (0.0, 0.0, 0.0)
    if goal.rpy is None and goal.quat is None:
        position = (frame @ placed)[:3, 3]
        axis = None
        if goal.axis is not None:
            given = _DIRECTIONS[goal.axis] if isinstance(goal.axis, str) else goal.axis
            axis = Vector3(*(frame[:3, :3] @ given).tolist())
        return PositionGoal(Vector3(*position.tolist()), axis, goal.position_tolerance, goal.angle_tolerance)
    placed[:3, :3] = from_quaternion(goal.quat) if goal.quat is not None else from_rpy(*(goal.rpy or (0.0, 0.0, 0.0)))
    return PoseGoal(pose(frame @ placed), goal.position_tolerance, goal.angle_tolerance, goal.beyond_reach)


def _text(goal: GoalOptions) -> str:
    if goal.pose is not None:
        return goal.pose
    if goal.joints:
        return ", ".join(f"{joint}={value:g}" for joint, value in goal.joints.items())
    where = ", ".join(f"{value:g}" for value in goal.xyz or (0.0, 0.0, 0.0))
    of = " from here" if goal.relative else f" from {goal.object}" if goal.object is not None else ""
    return f"({where}) m{of}"

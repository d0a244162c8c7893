"""Goals of joints: positions, and named poses of the robot YAML and the SRDF."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from ibrobot_kinematics.errors import KinematicsError
from ibrobot_kinematics.srdf import GroupState, read_srdf
from ibrobot_kinematics.urdf import read_urdf

from ibrobot_core.api import PlanCode, PlanningError, Robot, Vector
from ibrobot_planning.planner import (
    AnyGoal,
    ConstrainedGoal,
    Goal,
    JointGoal,
    NamedGoal,
    PlanRequest,
    invalid_goal,
    scaling_fault,
)


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


def joint_target(goal: JointGoal | NamedGoal, robot: Robot, joints: Sequence[str], start: Vector) -> Vector:
    """Goal positions of the planned `joints` [rad], shape (len(joints),).

    Raises:
        PlanningError: for unknown poses and joints, wrong shapes, and positions outside the limits.
    """
    named = without_names(goal, robot, joints)
    assert isinstance(named, JointGoal)
    goal = named
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

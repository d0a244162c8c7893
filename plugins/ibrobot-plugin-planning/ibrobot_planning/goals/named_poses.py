"""Named poses: those of the robot YAML, and the group states of the SRDF."""

from __future__ import annotations

from ibrobot_kinematics.errors import KinematicsError
from ibrobot_kinematics.srdf import GroupState, read_srdf
from ibrobot_kinematics.urdf import read_urdf

from ibrobot_core.api import PlanCode, PlanningError, Robot


def pose_names(robot: Robot) -> list[str]:
    """The names of a robot's poses.

    Raises:
        PlanningError: if its URDF or SRDF cannot be read.
    """
    return list(dict.fromkeys([*robot.description.poses, *(state.name for state in _group_states(robot))]))


def named_pose(robot: Robot, name: str) -> dict[str, float]:
    """Joint -> position [rad], of a pose of the robot YAML, or else of all group states of this name in the SRDF.

    Raises:
        PlanningError: for an unknown name, group states that contradict each other, or files that cannot be read.
    """
    if name in robot.description.poses:
        return dict(zip(robot.joint_names, robot.pose(name).tolist(), strict=True))
    found = [state for state in _group_states(robot) if state.name == name]
    if not found:
        raise _invalid(f"no pose {name!r}; the poses are: {', '.join(pose_names(robot)) or 'none'}")
    positions: dict[str, float] = {}
    for state in found:
        for joint, value in state.positions.items():
            if joint not in robot.joint_names:
                continue
            if positions.setdefault(joint, value) != value:
                groups = ", ".join(each.group for each in found)
                raise _invalid(f"pose {name!r} of the SRDF has two positions of joint {joint}, in groups {groups}")
    return positions


def _group_states(robot: Robot) -> tuple[GroupState, ...]:
    description = robot.description
    if description.srdf is None or description.urdf is None:
        return ()
    try:
        return read_srdf(description.srdf, read_urdf(description.urdf)).states
    except KinematicsError as error:
        raise _invalid(str(error)) from None


def _invalid(message: str) -> PlanningError:
    return PlanningError(message, PlanCode.INVALID_GOAL_CONSTRAINTS)

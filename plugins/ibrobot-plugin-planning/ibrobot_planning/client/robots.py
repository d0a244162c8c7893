"""Names of robots, like the modules of `pymoveit2.robots`."""

from __future__ import annotations

import attrs


@attrs.frozen
class RobotNames:
    """Names of joints and links of a robot; its methods are the functions of pymoveit2's modules."""

    joints: tuple[str, ...]
    base: str
    end_effector: str
    gripper_joints: tuple[str, ...]
    MOVE_GROUP_ARM: str
    MOVE_GROUP_GRIPPER: str
    OPEN_GRIPPER_JOINT_POSITIONS: tuple[float, ...]
    """[rad]."""
    CLOSED_GRIPPER_JOINT_POSITIONS: tuple[float, ...]
    """[rad]."""

    def joint_names(self) -> list[str]:
        """The joints of the arm."""
        return list(self.joints)

    def base_link_name(self) -> str:
        """The base frame."""
        return self.base

    def end_effector_name(self) -> str:
        """The tool centre point."""
        return self.end_effector

    def gripper_joint_names(self) -> list[str]:
        """The joints of the gripper."""
        return list(self.gripper_joints)


so101 = RobotNames(
    joints=("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll"),
    base="base_link",
    end_effector="gripperframe",
    gripper_joints=("gripper",),
    MOVE_GROUP_ARM="arm",
    MOVE_GROUP_GRIPPER="gripper",
    OPEN_GRIPPER_JOINT_POSITIONS=(1.5,),
    CLOSED_GRIPPER_JOINT_POSITIONS=(0.0,),
)
"""The SO-101 of the robot YAML `so101`."""

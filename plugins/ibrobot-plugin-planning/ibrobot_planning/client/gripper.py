"""The gripper, with the surface of pymoveit2's `GripperInterface`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ibrobot_core.api import JointState, NotSupported, PlanningError
from ibrobot_planning.client.motion import JointStates, Motions
from ibrobot_planning.client.node import BaseNode

_NEAR = 0.1
"""Fraction of the range from closed to open within which a gripper counts as open."""


class GripperInterface:
    """Opens and closes the gripper by the executor `gripper` of the robot's planning mode.

    The robot YAML sets planning groups, actions and effort: arguments about these have no effect.

    Args:
        node: the connection to the robot.
        gripper_joint_names: joints of the gripper.
        open_gripper_joint_positions: positions of the open gripper [rad].
        closed_gripper_joint_positions: positions of the closed gripper [rad].
        gripper_group_name: no effect.
        execute_via_moveit: no effect.
        ignore_new_calls_while_executing: whether calls during a motion are ignored.
        skip_planning: no effect.
        skip_planning_fixed_motion_duration: no effect.
        max_effort: no effect.
        callback_group: no effect.
        follow_joint_trajectory_action_name: no effect.
        gripper_command_action_name: no effect.
        use_move_group_action: no effect.

    Raises:
        PlanningError: for unknown joints, or if the number of positions is not that of joints.
    """

    def __init__(
        self, node: BaseNode, gripper_joint_names: Sequence[str], open_gripper_joint_positions: Sequence[float] | float,
        closed_gripper_joint_positions: Sequence[float] | float, gripper_group_name: str = "gripper",
        execute_via_moveit: bool = False, ignore_new_calls_while_executing: bool = False, skip_planning: bool = False,
        skip_planning_fixed_motion_duration: float = 0.5, max_effort: float = 0.0, callback_group: Any = None,
        follow_joint_trajectory_action_name: str = "", gripper_command_action_name: str = "",
        use_move_group_action: bool = False,
    ) -> None:  # fmt: skip
        self.joint_names = list(gripper_joint_names)
        self._open = _listed(open_gripper_joint_positions)
        self._closed = _listed(closed_gripper_joint_positions)
        self._states = JointStates(node)
        self._motions = Motions(node, ignore_new_calls_while_executing=ignore_new_calls_while_executing)
        for what, positions in (("open", self._open), ("closed", self._closed)):
            if len(positions) != len(self.joint_names):
                raise PlanningError(f"{len(positions)} {what} positions for {len(self.joint_names)} gripper joints")
        known = self._states.read().name
        if unknown := [name for name in self.joint_names if name not in known]:
            raise PlanningError(f"no joint {unknown[0]!r}; the joints are: {', '.join(known)}")

    def __call__(self) -> None:
        """Open a closed gripper, close an open one."""
        self.toggle()

    def toggle(self) -> None:
        """Open a closed gripper, close an open one."""
        self.close() if self.is_open else self.open()

    def open(self, skip_if_noop: bool = False) -> None:
        """Open; with `skip_if_noop` only if it is not open."""
        if not (skip_if_noop and self.is_open):
            self._move(self._open)

    def close(self, skip_if_noop: bool = False) -> None:
        """Close, or grasp what is between the fingers; with `skip_if_noop` only if it is open."""
        if not (skip_if_noop and self.is_closed):
            self._move(self._closed)

    def move_to_position(self, position: float) -> None:
        """Move all joints of the gripper to a position [rad]."""
        self._move([float(position)] * len(self.joint_names))

    def wait_until_executed(self) -> bool:
        """Wait for the end of the motion; returns whether it succeeded. Grasping something is a success."""
        return self._motions.wait()

    def force_reset_executing_state(self) -> None:
        """Do nothing: the robot knows whether it executes a motion."""

    def reset_open(self, sync: bool = True) -> None:
        """Raise NotSupported."""
        raise NotSupported("joints do not jump: open or close the gripper, or reset the simulation's episode")

    reset_closed = reset_open

    @property
    def joint_state(self) -> JointState:
        """The present joint state of the robot."""
        return self._states.read()

    @property
    def is_open(self) -> bool:
        """Whether all joints are near their open position."""
        state = self._states.read(again=True)
        present = dict(zip(state.name, state.position.tolist(), strict=True))
        ways = zip(self.joint_names, self._open, self._closed, strict=True)
        return all(abs(present[name] - opened) <= _NEAR * abs(opened - closed) for name, opened, closed in ways)

    @property
    def is_closed(self) -> bool:
        """Whether any joint is away from its open position."""
        return not self.is_open

    def _move(self, positions: list[float]) -> None:
        goal = ",".join(f"{name}={value!r}" for name, value in zip(self.joint_names, positions, strict=True))
        self._motions.ask("/planning/go_to", goal)


MoveIt2Gripper = GripperCommand = GripperInterface


def _listed(positions: Sequence[float] | float) -> list[float]:
    return [float(positions)] if isinstance(positions, int | float) else [float(each) for each in positions]

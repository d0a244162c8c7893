"""Twists of the tool, with the surface of pymoveit2's `MoveIt2Servo`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ibrobot_core.api import IbrobotError, NotSupported, PlanningError
from ibrobot_planning.client.node import BaseNode

type Triple = Sequence[float]

_AXES = ("x", "y", "z")


class MoveIt2Servo:
    """Moves the tool by twists, in a mode with the teleop `twist`.

    A twist is valid for the `timeout` of the robot's teleop, 0.1 s by default: call `servo` at 20 Hz or more.

    Args:
        node: the connection to the robot.
        frame_id: frame of the twists: `base_link`, or the tool centre point.
        namespace: no effect: `Node` has the robot's namespace.
        linear_speed: factor of linear velocities; with 1, these are in m/s.
        angular_speed: factor of angular velocities; with 1, these are in rad/s.
        enable_at_init: whether to call `enable`.
        callback_group: no effect.
        mode: the robot's mode with the teleop `twist`. Not in pymoveit2, like the next.
        mode_afterwards: the mode that `disable` enters, e.g. one with a planner; empty: the robot stays, and holds.
        service: the service of the teleop, named like its topic.

    Attributes:
        frame_id: as the argument.
        linear_speed: as the argument.
        angular_speed: as the argument.
    """

    def __init__(
        self, node: BaseNode, frame_id: str, namespace: str = "", linear_speed: float = 1.0,
        angular_speed: float = 1.0, enable_at_init: bool = True, callback_group: Any = None, *,
        mode: str = "servo", mode_afterwards: str = "", service: str = "/servo_node/delta_twist_cmds",
    ) -> None:  # fmt: skip
        self._node = node
        self._mode = mode
        self._mode_afterwards = mode_afterwards
        self._service = service
        self._enabled = False
        self.frame_id = frame_id
        self.linear_speed = linear_speed
        self.angular_speed = angular_speed
        if enable_at_init:
            self.enable()

    def __call__(self, linear: Triple = (0.0, 0.0, 0.0), angular: Triple = (0.0, 0.0, 0.0)) -> None:
        """As `servo`."""
        self.servo(linear, angular)

    def servo(
        self, linear: Triple = (0.0, 0.0, 0.0), angular: Triple = (0.0, 0.0, 0.0), enable_if_disabled: bool = True
    ) -> None:
        """Send a twist: velocities of the tool, multiplied by `linear_speed` and `angular_speed`.

        Raises:
            PlanningError: unless each has three numbers, and the robot takes twists.
        """
        if not self._enabled and not (enable_if_disabled and self.enable()):
            self._node.get_logger().warning("the twist is not sent: the servo is not enabled")
            return
        twist = {
            "linear": _scaled(linear, self.linear_speed, "linear"),
            "angular": _scaled(angular, self.angular_speed, "angular"),
        }
        self._node.call(self._service, {"header": {"frame_id": self.frame_id}, "twist": twist})

    def servo_jog(
        self, joint_names: Sequence[str] = (), velocities: Sequence[float] = (), enable_if_disabled: bool = True
    ) -> None:
        """Raise NotSupported."""
        raise NotSupported("twists move the tool, not single joints: use MoveIt2.move_to_configuration")

    def enable(self, wait_for_server_timeout_sec: float | None = 1.0, sync: bool = False) -> bool:
        """Enter the mode that takes twists; returns whether the robot did."""
        self._enabled = self._enter(self._mode)
        return self._enabled

    def disable(self, wait_for_server_timeout_sec: float | None = 1.0, sync: bool = False) -> bool:
        """Stop the tool, and enter `mode_afterwards`; returns whether the robot did."""
        if self._enabled:
            self.servo()
        self._enabled = False
        return not self._mode_afterwards or self._enter(self._mode_afterwards)

    @property
    def is_enabled(self) -> bool:
        """Whether the robot takes twists."""
        return self._enabled

    def _enter(self, mode: str) -> bool:
        try:
            self._node.call("/set_mode", mode)
        except IbrobotError as error:
            self._node.get_logger().warning("mode %s: %s", mode, error)
            return False
        return True


def _scaled(values: Triple, factor: float, name: str) -> dict[str, float]:
    numbers = [factor * float(value) for value in values]
    if len(numbers) != len(_AXES):
        raise PlanningError(f"{name}: expected x, y, z, got {len(numbers)} numbers")
    return dict(zip(_AXES, numbers, strict=True))

"""Between the vectors of a robot and those of a policy: positions in radians, unless a plugin has other units."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from numpy.typing import NDArray

from ibrobot_core.interfaces import Frame, PolicySpec
from ibrobot_core.robot import Vector

ACTION = "action"
"""Key of the action vector."""


class PolicyVectors:
    """Converts observations and actions between the robot and a policy. This class changes nothing: all in radians."""

    needs: tuple[str, ...] = ()
    """Keys of observations that `commands` needs, whatever the policy reads."""

    def __call__(self, values: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        """Convert values of a tick from radians to the unit; joints on the last axis. Copies arrays that change."""
        return dict(values)

    def frame(self, frame: Frame) -> Frame:
        """Convert a frame with its history and prefix to the unit."""
        return frame

    def commands(self, actions: Vector, seen: Mapping[str, NDArray[Any]], start: Vector) -> tuple[Vector, int]:
        """The positions of the joints [rad], shape (N, A), that actions of a policy command, and how many it held.

        Args:
            actions: in the policy's units, shape (N, F).
            seen: the observations for which the policy gave them, in radians.
            start: the joints' commands before them [rad], shape (A,).
        """
        return self.radians(ACTION, actions), 0

    def check(self, spec: PolicySpec) -> None:
        """Raise ContractError if a policy cannot give actions of this form; any can give positions of joints."""

    def radians(self, key: str, value: NDArray[Any]) -> NDArray[Any]:
        """Convert the vectors of one key from the unit to radians; joints on the last axis."""
        return value

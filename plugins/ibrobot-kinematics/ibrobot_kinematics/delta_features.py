"""Features `delta.JOINT`: commanded positions relative to the measured ones of the same row; and the gripper's own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, override

import numpy as np

from ibrobot_core.api import ContractError, Vector
from ibrobot_core.app import JointFeature
from ibrobot_kinematics.feature import ActionFeature

_PREFIX = "delta."


def delta_feature(model: Mapping[str, Any], paths: Sequence[str], joints: Sequence[str]) -> JointFeature:
    """The numbers that paths `delta.JOINT` name.

    Raises:
        ContractError: in an observation, or if they are not all of the action's joints in their order.
    """
    if not joints:
        raise ContractError(f"{paths[0]!r}: only an action is relative to the measured positions")
    wanted = tuple(f"{_PREFIX}{joint}" for joint in joints)
    if tuple(paths) != wanted:
        raise ContractError(f"expected all joints of the executor in their order: [{', '.join(wanted)}]")
    return JointFeature(tuple(joints), tuple(f"{joint}.delta" for joint in joints))


class Deltas(ActionFeature):
    """Positions relative to the measured ones, in the units of the dataset, as LeRobot subtracts them."""

    in_units: ClassVar[bool] = True

    def __init__(self, joints: Sequence[str]) -> None:
        self.names = tuple(f"{joint}.delta" for joint in joints)
        self.reference = tuple(joints)

    @override
    def encode(self, positions: Vector, measured: Vector) -> Vector:
        return np.asarray(positions - measured)

    @override
    def decode(self, numbers: Vector, measured: Vector, start: Vector) -> tuple[Vector, int]:
        return measured + numbers, 0


class Positions(ActionFeature):
    """Positions of joints under other names, or as they are."""

    in_units: ClassVar[bool] = True

    def __init__(self, names: Sequence[str]) -> None:
        self.names = tuple(names)

    @override
    def encode(self, positions: Vector, measured: Vector) -> Vector:
        return positions

    @override
    def decode(self, numbers: Vector, measured: Vector, start: Vector) -> tuple[Vector, int]:
        return numbers, 0

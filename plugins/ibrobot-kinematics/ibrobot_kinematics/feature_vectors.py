"""Rows and chunks of contracts whose actions have features: the counterpart of `JointUnits` for these."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, override

import attrs
import numpy as np
from ibrobot_calibration.joint_units import JointUnits
from numpy.typing import NDArray

from ibrobot_core.api import ACTION, ActionPart, Contract, ContractError, Frame, JointState, PolicySpec, Vector
from ibrobot_kinematics.delta_features import Deltas, Positions
from ibrobot_kinematics.feature import ActionFeature
from ibrobot_kinematics.tool_features import PREFIX, Piece, action_features


@attrs.frozen(eq=False)
class _Part:
    """A part of the action vector."""

    feature: ActionFeature
    joints: NDArray[np.intp]
    """Its joints in the vector of joints."""
    numbers: NDArray[np.intp]
    """Its numbers in the vector of the policy."""


class FeatureVectors(JointUnits):
    """Converts rows of joints to rows with the features of the contract, and a policy's actions back.

    Args:
        norm_mode: as for `JointUnits`, for all elements that are positions of joints.
        contract: the contract.
        calibration: likewise.
        document: likewise; also has the limits of the joints.

    Raises:
        CalibrationError: as `JointUnits`.
        ContractError: if an action is relative to the position of a joint that no observation has.
    """

    def __init__(
        self,
        norm_mode: str,
        contract: Contract,
        calibration: Mapping[str, Mapping[str, Any]],
        document: Mapping[str, Any],
    ) -> None:
        super().__init__(norm_mode, contract, calibration, document)
        plain = tuple(attrs.evolve(part, features=(), model={}) for part in contract.action_parts)
        self._joint_units = JointUnits(norm_mode, attrs.evolve(contract, action_parts=plain), calibration, document)
        robot = document.get("robot") or {}
        limits = {each["name"]: (float(each["lower"]), float(each["upper"])) for each in robot.get("joints", ())}
        self._parts: list[_Part] = []
        at = begin = 0
        for part in contract.action_parts:
            for piece in _pieces(part, limits):
                joints = [at + part.joints.index(name) for name in piece.joints]
                first = begin + piece.first
                numbers = np.arange(first, first + len(piece.feature.names), dtype=np.intp)
                self._parts.append(_Part(piece.feature, np.array(joints, dtype=np.intp), numbers))
            at, begin = at + len(part.joints), begin + len(part.names)
        self._size = begin
        self._places = measured_places(contract)
        wanted = [joint for part in self._parts for joint in part.feature.reference]
        if lacking := [joint for joint in wanted if joint not in self._places]:
            raise ContractError(missing_reference(lacking[0]))
        self.needs = tuple(dict.fromkeys(self._places[joint][0] for joint in wanted))

    @override
    def __call__(self, values: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        converted = super().__call__({key: value for key, value in values.items() if key != ACTION})
        if ACTION in values:
            converted[ACTION] = self._encoded(values, values[ACTION])
        return converted

    @override
    def frame(self, frame: Frame) -> Frame:
        prefix = None if frame.prefix is None else self._encoded(frame.values, frame.prefix)
        return attrs.evolve(super().frame(attrs.evolve(frame, prefix=None)), prefix=prefix)

    @override
    def commands(self, actions: Vector, seen: Mapping[str, NDArray[Any]], start: Vector) -> tuple[Vector, int]:
        if actions.ndim != 2 or actions.shape[1] != self._size:
            raise ValueError(f"a chunk must have the shape (N, {self._size}), got {actions.shape}")
        joints = np.tile(np.asarray(start, dtype=np.float64), (len(actions), 1))
        converted = joints.copy()
        inside = self._joint_units({ACTION: np.asarray(start, dtype=np.float64)})[ACTION]
        held = 0
        for part in self._parts:
            feature = part.feature
            before = inside if feature.in_units else start
            positions, missed = feature.decode(
                actions[:, part.numbers].astype(np.float64), self._measured(feature, seen), before[part.joints]
            )
            held += missed
            (converted if feature.in_units else joints)[:, part.joints] = positions
        in_radians = self._joint_units.radians(ACTION, converted)
        for part in self._parts:
            if part.feature.in_units:
                joints[:, part.joints] = in_radians[:, part.joints]
        return joints, held

    @override
    def check(self, spec: PolicySpec) -> None:
        relative = next((part.feature.names[0] for part in self._parts if part.feature.reference), None)
        if relative is not None and spec.chunk_size > 1:
            raise ContractError(
                f"action: {relative} is relative to what is measured when the action begins, which nobody knows yet "
                f"for the later ones of a chunk of {spec.chunk_size}: use a policy with one action per chunk (LeRobot: "
                "n_action_steps: 1), or absolute actions; the policy may subtract the state itself"
            )

    def _encoded(self, values: Mapping[str, NDArray[Any]], joints: NDArray[Any]) -> NDArray[Any]:
        """The policy's numbers, shape (…, F), for positions of the joints [rad], shape (…, A)."""
        exact = joints.astype(np.float64)
        inside = self._joint_units({ACTION: exact})[ACTION]
        numbers = np.empty((*joints.shape[:-1], self._size))
        for part in self._parts:
            given = (inside if part.feature.in_units else exact)[..., part.joints]
            numbers[..., part.numbers] = part.feature.encode(given, self._measured(part.feature, values))
        return numbers.astype(joints.dtype)

    def _measured(self, feature: ActionFeature, values: Mapping[str, NDArray[Any]]) -> Vector:
        """The measured positions that a feature is relative to, from the observations of the same row."""
        if not feature.reference:
            return np.empty(0)
        observed = super().__call__({key: values[key] for key in self.needs}) if feature.in_units else values
        places = (self._places[joint] for joint in feature.reference)
        return np.array([observed[key][index] for key, index in places], dtype=np.float64)


def measured_places(contract: Contract) -> dict[str, tuple[str, int]]:
    """Joint -> key and index of its measured position in the observations; the first of several."""
    places: dict[str, tuple[str, int]] = {}
    for key in contract.observations:
        at = 0
        for part in contract.parts(key):
            leaves = part.selection.leaves if part.type == JointState.ros_type else ()
            for index, leaf in enumerate(leaves):
                if (leaf.kind, leaf.field) == ("joint", "position"):
                    places.setdefault(leaf.part, (key, at + index))
            at += part.feature.shape[0]
    return places


def missing_reference(joint: str) -> str:
    """The message for a relative action without what it is relative to."""
    return (
        f"a relative action needs the measured positions in an observation of the contract; position.{joint} is missing"
    )


def _pieces(part: ActionPart, limits: Mapping[str, tuple[float, float]]) -> list[Piece]:
    if part.features and part.features[0].startswith(PREFIX):
        return action_features(part.model.get("tool", {}), part.features, part.joints, limits or None)
    return [Piece(Deltas(part.joints) if part.features else Positions(part.joints), part.joints, 0)]

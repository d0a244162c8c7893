"""Conversion of joint positions between radians and LeRobot's units, for datasets and policies."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, override

import attrs
import numpy as np
from numpy.typing import NDArray

from ibrobot_calibration.calibration import JointCalibration, load_calibration
from ibrobot_core.api import ACTION, CalibrationError, Contract, Frame, JointState, NotSupported
from ibrobot_core.app import PolicyVectors, RobotConfig, UnitsDescriptor, installed_plugins

LEROBOT_MODES = ("range_m100_100", "range_0_100", "degrees")
"""LeRobot's units of joint positions, named as in its `MotorNormMode`."""
_CLOSED_MODE = "range_0_100"
_UNKNOWN_ENDS = (
    "{0}: does joint {1!r} range from 0 to 100, as LeRobot's grippers do in every unit? The robot YAML has no hardware "
    "that states it: add `hardware`, or name those joints with --anchored gripper ('' if none does)"
)
_DEGREES_PER_RADIAN = 360 / (JointCalibration.TICKS_PER_TURN - 1) * JointCalibration.TICKS_PER_TURN / (2 * math.pi)
"""LeRobot counts a tick less for a turn."""


type _Numbers = float | NDArray[Any]
"""A number, or one per joint."""


def radians_to_lerobot(
    radians: _Numbers, mode: str, lower: _Numbers, upper: _Numbers, inverted: bool | NDArray[np.bool_]
) -> NDArray[Any]:
    """Radians -> LeRobot's units, as its `MotorsBus` (0.6) normalises the ticks of a servo.

    - `range_m100_100`: the calibrated range -> -100 to 100, clipped.
    - `range_0_100` (the gripper): -> 0 to 100, clipped.
    - `degrees`: from the middle of the range, not clipped; they increase with the ticks, also if inverted.

    Args:
        radians: positions [rad], any shape.
        mode: one of `LEROBOT_MODES`.
        lower: the lesser end of the calibrated range [rad]; a number, or one per joint.
        upper: the greater end; likewise.
        inverted: whether radians decrease as ticks increase; likewise.
    """
    converted: NDArray[Any]
    if mode == "degrees":
        converted = (radians - (lower + upper) / 2) * _DEGREES_PER_RADIAN * np.where(inverted, -1.0, 1.0)
        return converted
    least = 0.0 if mode == _CLOSED_MODE else -100.0
    converted = (np.clip(radians, lower, upper) - lower) / (upper - lower) * (100.0 - least) + least
    return converted


def lerobot_to_radians(
    values: _Numbers, mode: str, lower: _Numbers, upper: _Numbers, inverted: bool | NDArray[np.bool_]
) -> NDArray[Any]:
    """LeRobot's units -> radians; the inverse of `radians_to_lerobot`."""
    converted: NDArray[Any]
    if mode == "degrees":
        converted = values * np.where(inverted, -1.0, 1.0) / _DEGREES_PER_RADIAN + (lower + upper) / 2
        return converted
    least = 0.0 if mode == _CLOSED_MODE else -100.0
    fraction = (np.clip(values, least, 100.0) - least) / (100.0 - least)
    converted = fraction * (upper - lower) + lower
    return converted


@attrs.frozen
class _Elements:
    """Elements of a vector that are joint positions of one unit."""

    indices: NDArray[np.intp]
    mode: str
    calibration: Mapping[str, NDArray[Any]]
    """Arguments of `radians_to_lerobot`, one number per element."""


class JointUnits(PolicyVectors):
    """Converts the joint positions of observations and actions; leaves velocities, efforts and all else unchanged.

    `degrees` and `range_m100_100` are LeRobot's units for the joints of an arm. As in LeRobot, a joint that the
    hardware anchors at its closed end ranges from 0 to 100 in both.

    Args:
        norm_mode: one of `units.NORM_MODES`.
        contract: the contract, which states the elements that are joint positions.
        calibration: joint -> fields of `JointCalibration`. With LeRobot's fields alone, 0 rad is at the pose, as in
            old recordings that do not state it.
        document: the robot YAML as plain values; states the anchored joints if `calibration` has no `closed_at`, as
            in older recordings, or if the hardware's plugin is not installed.

    Raises:
        CalibrationError: if the calibration of a joint is needed and missing, or nothing states the anchored joints.
        ValueError: for an unknown unit.
    """

    def __init__(
        self,
        norm_mode: str,
        contract: Contract,
        calibration: Mapping[str, Mapping[str, Any]],
        document: Mapping[str, Any],
    ) -> None:
        self._elements: dict[str, list[_Elements]] = {}
        if norm_mode == "radians":
            return
        if norm_mode not in LEROBOT_MODES:
            raise ValueError(f"unknown unit {norm_mode!r}; LeRobot has: {', '.join(LEROBOT_MODES)}")
        closed = _closed_ends(calibration, document)
        for key, joints in _position_joints(contract).items():
            modes: dict[str, dict[int, str]] = {}
            for index, joint in joints.items():
                if not document.get("hardware") and "closed_at" not in calibration.get(joint, {"closed_at": None}):
                    raise CalibrationError(_UNKNOWN_ENDS.format(norm_mode, joint))
                modes.setdefault(_CLOSED_MODE if joint in closed else norm_mode, {})[index] = joint
            self._elements[key] = [_elements(mode, named, calibration, closed) for mode, named in modes.items()]

    @override
    def __call__(self, values: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        return {key: self._converted(key, value, radians_to_lerobot) for key, value in values.items()}

    @override
    def frame(self, frame: Frame) -> Frame:
        prefix = None if frame.prefix is None else self._converted(ACTION, frame.prefix, radians_to_lerobot)
        history = tuple(self.frame(each) for each in frame.history)
        return attrs.evolve(frame, values=self(frame.values), prefix=prefix, history=history)

    @override
    def radians(self, key: str, value: NDArray[Any]) -> NDArray[Any]:
        return self._converted(key, value, lerobot_to_radians)

    def _converted(self, key: str, value: NDArray[Any], convert: Callable[..., NDArray[Any]]) -> NDArray[Any]:
        if key not in self._elements:
            return value
        vector = value.astype(np.float64)
        for group in self._elements[key]:
            vector[..., group.indices] = convert(vector[..., group.indices], group.mode, **group.calibration)
        return vector.astype(value.dtype)


def calibrated_units(
    norm_mode: str, contract: Contract, calibration: Mapping[str, Mapping[str, Any]], document: Mapping[str, Any]
) -> JointUnits:
    """The conversion by a calibration, `JointUnits` or that of the actions' features; its arguments and errors."""
    words = (part.features[0].partition(".")[0] for part in contract.action_parts if part.features)
    kind = next((installed_plugins().features[word].vectors for word in words), JointUnits)
    made: JointUnits = kind(norm_mode, contract, calibration, document)
    return made


def recorded_units(
    type_: str | None, norm_mode: str, contract: Contract, calibration: Mapping[str, Mapping[str, Any]],
    document: Mapping[str, Any],
) -> PolicyVectors:  # fmt: skip
    """The conversion of a recording's vectors, as that of a run by `models.NAME.units`.

    Args:
        type_: the type of the units; None for the default.
        norm_mode: as for `JointUnits`, as are the others.
        contract: the contract.
        calibration: joint -> numbers.
        document: the robot YAML as plain values.

    Raises:
        PluginError: if the type is not installed, or several are a default.
        NotSupported: if it converts runs only.
        CalibrationError: as `JointUnits`.
    """
    has_features = any(part.features for part in contract.action_parts)
    if norm_mode == "radians" and type_ is None and not has_features:
        return PolicyVectors()
    registry = installed_plugins()
    descriptor = registry.find("units", type_ or registry.default("units"))
    assert isinstance(descriptor, UnitsDescriptor)
    made: PolicyVectors | None = descriptor.of_recording(norm_mode, contract, calibration, document)
    if made is None:
        raise NotSupported(f"units of type {descriptor.type!r} convert the vectors of runs, not of recordings")
    return made


def calibrations(config: RobotConfig) -> dict[str, dict[str, dict[str, Any]]]:
    """The calibrations of the hardware in use, by its name, as stored in recordings; empty for a simulation.

    Each joint has `closed_at`.

    Raises:
        CalibrationError: if a calibration cannot be read.
    """
    return {
        name: with_closed_ends(load_calibration(each.options.calibration, each.joints).snapshot(), config)
        for name, each in config.hardware.items()
        if each.options.calibration is not None
    }


def with_closed_ends(calibration: Mapping[str, Mapping[str, Any]], config: RobotConfig) -> dict[str, dict[str, Any]]:
    """A calibration, joint -> fields of `JointCalibration`, completed with the hardware's `closed_at`."""
    return {
        joint: {**numbers, "closed_at": config.closed_ends[joint]} if joint in config.closed_ends else dict(numbers)
        for joint, numbers in calibration.items()
    }


def _position_joints(contract: Contract) -> dict[str, dict[int, str]]:
    """Key -> element -> joint, for all elements that are joint positions."""
    plain = [name if not part.features else "" for part in contract.action_parts for name in part.names]
    joints_of: dict[str, dict[int, str]] = {ACTION: {i: name for i, name in enumerate(plain) if name}}
    for key in contract.observations:
        at = 0
        for part in contract.parts(key):
            if part.type == JointState.ros_type:
                for i, leaf in enumerate(part.selection.leaves):
                    if (leaf.kind, leaf.field) == ("joint", "position"):
                        joints_of.setdefault(key, {})[at + i] = leaf.part
            at += part.feature.shape[0]
    return {key: joints for key, joints in joints_of.items() if joints}


def _elements(
    mode: str, named: Mapping[int, str], calibration: Mapping[str, Mapping[str, Any]], closed: Mapping[str, float]
) -> _Elements:
    for joint in named.values():
        if joint not in calibration:
            remedy = "name one by `calibration` in the YAML or --calibration"
            has = f"it has: {', '.join(calibration)}" if calibration else f"there is none; {remedy}"
            raise CalibrationError(f"{mode} needs the calibration of joint {joint!r}; {has}")
    each = {joint: JointCalibration(**calibration[joint]) for joint in named.values()}
    lower, upper = np.transpose([joint.ends(closed.get(name)) for name, joint in each.items()])
    inverted = np.array([joint.inverted for joint in each.values()])
    return _Elements(np.array(list(named), np.intp), mode, {"lower": lower, "upper": upper, "inverted": inverted})


def _closed_ends(calibration: Mapping[str, Mapping[str, Any]], document: Mapping[str, Any]) -> dict[str, float]:
    """Joint -> its lower limit [rad], for joints anchored at their closed end."""
    hardware = document.get("hardware") or {}
    components = [hardware] if "type" in hardware else list(hardware.values())
    anchored = {name for each in components for name in each.get("anchored", ("gripper",))}
    joints = (document.get("robot") or {}).get("joints", ())
    ends = {joint["name"]: float(joint["lower"]) for joint in joints if joint["name"] in anchored}
    ends |= {joint: numbers["closed_at"] for joint, numbers in calibration.items() if "closed_at" in numbers}
    return {joint: end for joint, end in ends.items() if end is not None}

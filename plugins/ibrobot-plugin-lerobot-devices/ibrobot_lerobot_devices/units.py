"""Conversion between LeRobot's values of a joint and radians."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import attrs

if TYPE_CHECKING:
    from ibrobot_core.api import Vector

POSITION = (".pos", ".q")
"""Ends of the names of features that are joint positions."""
VELOCITY = (".vel", ".dq")
EFFORT = (".torque", ".tau", ".effort", ".eff")
DEGREES, RADIANS, SYMMETRIC, PERCENT = "degrees", "radians", "range_m100_100", "range_0_100"
METRES = "metres"
UNITS = (DEGREES, RADIANS, SYMMETRIC, PERCENT, METRES)
"""LeRobot's units of joints: `range_…` are shares of the calibrated range; bases have metres."""
AXES = {"x": METRES, "y": METRES, "theta": DEGREES}
"""The axes of a base, with the units per second in which LeRobot's own robots are driven along and about them."""
_DRIVEN = {DEGREES: math.pi / 180, RADIANS: 1.0, METRES: 1.0}

OTHERS = "*"
"""In the option `units`: the joints whose unit neither LeRobot nor the option says."""


@attrs.frozen
class Scale:
    """A linear conversion: radians = `factor` * value + `offset`."""

    factor: float
    offset: float = 0.0


@attrs.frozen
class Mapped:
    """A feature of LeRobot's that is a joint of the robot."""

    feature: str
    """Without its end, e.g. `shoulder_pan`."""
    joint: str
    unit: str
    scale: Scale


@attrs.frozen
class Choices:
    """What the options say about the conversion."""

    joints: Mapping[str, str]
    """LeRobot's name -> joint, where they differ."""
    units: Mapping[str, str]
    """LeRobot's name -> unit, where LeRobot does not say it."""
    zero_at: str
    anchored: Sequence[str]
    inverted: Sequence[str]
    scaled: Sequence[str] = ()
    """Joints whose shares of the calibrated range map to the limits."""


class UnitProblem(Exception):
    """A feature has no joint, or a joint no unit; the text is for the operator."""


def bases(features: Sequence[str], ends: Sequence[str]) -> dict[str, str]:
    """Name without its end -> whole name, of the features with one of these ends."""
    return {name.removesuffix(end): name for name in features for end in ends if name.endswith(end)}


def driven(features: Sequence[str]) -> dict[str, str]:
    """Name without its end -> whole name, of the velocities without a position: the axes of a base."""
    positions = bases(features, POSITION)
    return {base: name for base, name in bases(features, VELOCITY).items() if base not in positions}


def unit_of(feature: str, motors: Mapping[str, Mapping[str, Any]], units: Mapping[str, str]) -> str:
    """The unit of a feature that is a position or an axis of a base; empty if neither LeRobot nor `units` says it.

    Args:
        feature: its name, with its end.
        motors: what LeRobot says, by feature without its end; see `library.motors`.
        units: LeRobot's name -> unit.
    """
    (base,) = bases([feature], POSITION) or bases([feature], VELOCITY)
    known = motors.get(base, {})
    if not feature.endswith(POSITION):
        unit = units.get(base) or known.get("rate") or ""
        return unit if unit in _DRIVEN else ""
    unit = units.get(base) or known.get("unit") or units.get(OTHERS, "")
    return unit if unit in UNITS else ""


def map_axes(
    features: Sequence[str], motors: Mapping[str, Mapping[str, Any]], choices: Choices, wanted: Sequence[str]
) -> list[Mapped]:
    """Those of the joints `wanted` that are axes of a base, in that order; `features` are names of LeRobot's.

    Raises:
        UnitProblem: if the unit of an axis is not known.
    """
    axes = driven(features)
    by_joint = {choices.joints.get(base, base): base for base in axes}
    mapped = []
    for joint in wanted:
        if (base := by_joint.get(joint)) is None:
            continue
        unit = unit_of(axes[base], motors, choices.units)
        if not unit:
            raise UnitProblem(
                f"LeRobot does not say the unit of the base's {base!r}: give it as units: {{{base}: UNIT}}, with "
                "metres, radians or degrees, each a second"
            )
        turned = -1.0 if joint in choices.inverted else 1.0
        mapped.append(Mapped(base, joint, unit, Scale(turned * _DRIVEN[unit])))
    return mapped


def map_joints(
    features: Sequence[str],
    motors: Mapping[str, Mapping[str, Any]],
    choices: Choices,
    wanted: Sequence[str],
    limits: Mapping[str, tuple[float, float]],
) -> list[Mapped]:
    """The joints of a device, in the order of `wanted`.

    Args:
        features: names of LeRobot's features.
        motors: properties of the motors, by feature.
        choices: the options.
        wanted: the joints to map.
        limits: joint -> its limits [rad].

    Raises:
        UnitProblem: if a joint has no feature, or a feature no unit.
    """
    positions = bases(features, POSITION)
    by_joint = {choices.joints.get(base, base): base for base in positions}
    joints = []
    for joint in wanted:
        base = by_joint.get(joint)
        if base is None:
            raise UnitProblem(
                f"LeRobot has no joint {joint!r}; it has {', '.join(positions) or 'none'}: give the names that differ "
                "as names: {LEROBOT'S: JOINT}"
            )
        motor = motors.get(base, {})
        unit = unit_of(positions[base], motors, choices.units)
        if not unit:
            raise UnitProblem(
                f"LeRobot does not say the unit of {base!r}: give it as units: {{{base}: UNIT}}, or {{'*': UNIT}} for "
                f"all, with one of {', '.join(UNITS)}"
            )
        joints.append(Mapped(base, joint, unit, _scale(unit, motor, joint, choices, limits[joint])))
    return joints


def _scale(unit: str, motor: Mapping[str, Any], joint: str, choices: Choices, limits: tuple[float, float]) -> Scale:
    turned = -1.0 if joint in choices.inverted else 1.0
    by_share = joint in choices.scaled and unit in (SYMMETRIC, PERCENT)
    if "resolution" in motor and unit not in (RADIANS, METRES) and not by_share:
        return _by_calibration(unit, motor, joint, choices, limits[0])
    lower, upper = limits
    match unit:
        case "degrees":
            return Scale(turned * math.pi / 180)
        case "radians" | "metres":
            return Scale(turned)
        case "range_0_100":
            half = (upper - lower) / 100
            return Scale(half, lower) if turned > 0 else Scale(-half, upper)
    return Scale(turned * (upper - lower) / 200, (upper + lower) / 2)


def _by_calibration(unit: str, motor: Mapping[str, Any], joint: str, choices: Choices, lower: float) -> Scale:
    """Scale by the encoder's ticks, as LeRobot counts them."""
    resolution, first, last = motor["resolution"], motor["range_min"], motor["range_max"]
    span, backwards = last - first, motor["reversed"]
    # ticks = slope * value + start
    if unit == DEGREES:
        slope, start = (resolution - 1) / 360, (first + last) / 2
    elif unit == SYMMETRIC:
        slope, start = span / 200 * (-1 if backwards else 1), (first + last) / 2
    else:
        slope, start = (-span / 100, last) if backwards else (span / 100, first)
    angle = 2 * math.pi / resolution * (-1 if backwards != (joint in choices.inverted) else 1)
    if joint in choices.anchored:
        zero = (first if angle > 0 else last) - lower / angle
    else:
        zero = resolution / 2 if choices.zero_at == "pose" else (first + last) / 2
    return Scale(angle * slope, angle * (start - zero))


def columns(mapped: Sequence[Mapped]) -> tuple[Vector, Vector]:
    """Factors and offsets of joints, each of shape (J,)."""
    import numpy as np

    return np.array([each.scale.factor for each in mapped]), np.array([each.scale.offset for each in mapped])

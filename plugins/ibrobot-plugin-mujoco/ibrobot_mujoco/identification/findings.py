"""What an owner wants to know of an arm: its delay, backlash, weak joints, and what has changed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Literal

import attrs
import numpy as np

from ibrobot_mujoco.identification.fit import ARM, Fitted, Known
from ibrobot_mujoco.parameters import ArmParameters

_SHARE = 0.7
"""A joint with less than this share of the others' gain is weak."""
_FRICTION = 2.5
"""A joint with so many times the others' friction is stiff."""
_SIGMAS = 3.0
"""A difference counts from so many of its standard deviations."""
_CHANGED = 0.15
"""And from this share of the value."""
_LEAST = {
    "backlash": 0.006, "bias": 0.008, "delay": 0.005, "gravity_compensation": 0.1, "frictionloss": 0.02,
    "armature": 0.004, "damping": 0.06,
}  # fmt: skip
"""Or from this difference, if that is more, in the unit of the parameter."""
_BACKLASH = 0.009
"""Backlash that is worth a word [rad]: half a degree."""
_DRIFTS = ("kp", "frictionloss", "damping", "backlash", "bias", "torque_limit")

MOTIONS: Mapping[str, str] = {
    "kp": "hold the arm stretched out and folded for some seconds each, so that gravity pulls at the joint",
    "damping": "move the joint fast over most of its range",
    "frictionloss": "move the joint slowly, to and fro",
    "armature": "move the arm with a known weight in the gripper: positions alone show torques and inertias up to a "
    "factor, for which the published inertia of the rotor stands",
    "torque_limit": "lift a known weight, or press against a scale: a servo shows its limit only where it reaches it",
    "backlash": "move the joint by one to three degrees, to and fro, in several poses",
    "bias": "hold several poses for some seconds each",
    "delay": "begin and end motions abruptly, with all joints",
    "gravity_compensation": "hold the arm stretched out, with a known weight and without",
}
"""Parameter -> the motion that shows it."""
BY_EXCITATION = frozenset(MOTIONS) - {"torque_limit", "gravity_compensation", "armature"}
"""What `--excite` can show."""


@attrs.frozen
class Finding:
    """Something that an owner should know."""

    kind: Literal["delay", "backlash", "weak", "stiff", "drift", "holding"]
    joint: str
    text: str
    is_fault: bool = False


def findings_of(fitted: Fitted, grips: Mapping[str, bool], last: ArmParameters | None) -> list[Finding]:
    """What stands out.

    Args:
        fitted: the fit.
        grips: joint -> whether it grips.
        last: the identification before; None without one.
    """
    return [
        *_delay(fitted), *_backlash(fitted), *_weak(fitted, grips), *_stiff(fitted), *_holding(fitted),
        *(_drifts(fitted, last) if last is not None else ()),
    ]  # fmt: skip


def _delay(fitted: Fitted) -> Iterator[Finding]:
    delay = fitted.of(ARM, "delay")
    if delay.confidence != "unknown":
        text = f"A command reaches the servos after {1e3 * delay.value:.0f} ms (± {1e3 * delay.deviation:.0f} ms)."
        yield Finding("delay", ARM, text)


def _backlash(fitted: Fitted) -> Iterator[Finding]:
    for each in fitted.known:
        if each.name == "backlash" and each.value > max(_BACKLASH, _SIGMAS * each.deviation):
            angle, deviation = np.rad2deg(each.value), np.rad2deg(each.deviation)
            yield Finding(
                "backlash", each.joint, f"{each.joint} has {angle:.1f} deg of backlash (± {deviation:.1f} deg).",
                is_fault=bool(angle > 1.0),
            )  # fmt: skip


def _weak(fitted: Fitted, grips: Mapping[str, bool]) -> Iterator[Finding]:
    carry = [each for each in fitted.known if each.confidence != "unknown" and not grips.get(each.joint, False)]
    gains = [each for each in carry if each.name == "kp"]
    limits = [each for each in carry if each.name == "torque_limit"]
    said: set[str] = set()
    for named, unit, what in ((limits, "Nm", "gives up at"), (gains, "Nm/rad", "has a gain of only")):
        if len(named) < 3:
            continue
        middle = float(np.median([each.value for each in named]))
        for each in named:
            surely = each.value + _SIGMAS * each.deviation < middle
            if each.value < _SHARE * middle and surely and each.joint not in said:
                said.add(each.joint)
                yield Finding(
                    "weak", each.joint,
                    f"{each.joint} is weaker than the others: it {what} {each.value:.2g} {unit}, where their median is "
                    f"{middle:.2g}. Check its voltage, P, torque limit and gears.", is_fault=True,
                )  # fmt: skip


def _stiff(fitted: Fitted) -> Iterator[Finding]:
    frictions = [each for each in fitted.known if each.name == "frictionloss" and each.confidence != "unknown"]
    if len(frictions) < 3:
        return
    middle = float(np.median([each.value for each in frictions]))
    for each in frictions:
        surely = each.value - _SIGMAS * each.deviation > middle
        if each.value > max(_FRICTION * middle, middle + 0.05) and surely:
            yield Finding(
                "stiff", each.joint,
                f"{each.joint} moves stiffly: {each.value:.2g} Nm of dry friction, where the median is {middle:.2g}. "
                "Look for a cable in the way, a tight screw or a worn gear.", is_fault=True,
            )  # fmt: skip


def _holding(fitted: Fitted) -> Iterator[Finding]:
    for joint, share in fitted.held.items():
        if share > 0.02:
            yield Finding(
                "holding", joint, f"{joint} held something for {100 * share:.0f} % of the time, which is left out."
            )


def _drifts(fitted: Fitted, last: ArmParameters) -> Iterator[Finding]:
    before = last.identified.deviations
    for each in fitted.known:
        if each.name not in (*_DRIFTS, "delay") or each.confidence == "unknown":
            continue
        if each.joint != ARM and each.joint not in last.joints:
            continue
        source = attrs.asdict(last if each.joint == ARM else last.joints[each.joint], recurse=False)
        old, sigma = source[each.name], before.get(each.joint, {}).get(each.name)
        if old is None or sigma is None or f"{each.joint}.{each.name}" in last.identified.unknown:
            continue
        change = each.value - old
        least = max(_SIGMAS * float(np.hypot(each.deviation, sigma)), _CHANGED * abs(old), _LEAST.get(each.name, 0.0))
        if abs(change) > least:
            yield Finding(
                "drift", each.joint,
                f"{each.joint}: {each.name} was {shown(each.name, old)} and is now {shown(each.name, each.value)}.",
                is_fault=True,
            )  # fmt: skip


def shown(name: str, value: float) -> str:
    """A value in the unit that people use."""
    if name in ("backlash", "bias"):
        return f"{np.rad2deg(value):.2f} deg"
    if name == "delay":
        return f"{1e3 * value:.0f} ms"
    units = {"kp": "Nm/rad", "damping": "Nm s/rad", "frictionloss": "Nm", "armature": "kg m^2", "torque_limit": "Nm"}
    return f"{value:.3g} {units.get(name, '')}".strip()


def unknown_of(fitted: Fitted) -> list[tuple[str, str]]:
    """What the recordings could not tell, and what motion would: lines, parameter by parameter."""
    by_name: dict[str, list[Known]] = {}
    for each in fitted.known:
        if each.confidence == "unknown":
            by_name.setdefault(each.name, []).append(each)
    lines = []
    for name, several in by_name.items():
        joints = [each.joint for each in several]
        how = " (`ibrobot identify --excite ROBOT` does)" if name in BY_EXCITATION else ""
        what = name if joints == [ARM] else f"{name} of {', '.join(joints)}"
        least = _least_torques(fitted, joints) if name == "torque_limit" else ""
        lines.append((what, f"{least}{MOTIONS[name]}{how}"))
    return lines


def _least_torques(fitted: Fitted, joints: Sequence[str]) -> str:
    order = list(fitted.parameters.joints)
    most = ", ".join(f"{joint} {fitted.needed[order.index(joint)]:.2g} Nm" for joint in joints)
    return f"the servos gave at least what the motion needed ({most}); "

"""Health of an arm's joints: errors that servos report, and values beyond their warning and fault levels."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import attrs
import numpy as np
from numpy.typing import NDArray

from ibrobot_core.api import Condition, Severity, Vector
from ibrobot_feetech.errors import Place
from ibrobot_feetech.options import FollowerOptions
from ibrobot_feetech.protocol import OVERLOAD, faults
from ibrobot_feetech.supply import Supply

_QUANTITIES = {0: "voltage", 1: "position sensor", 2: "temperature", 3: "current", 5: "load"}
"""Error bit -> affected quantity; any other bit is its own quantity."""
_LIGHTER = ("temperature", "current", "load")
"""Quantities that a smaller load relieves."""
_REMEDIES = {
    "temperature": "let the arm rest without load",
    "voltage": "check the power supply, its cables, and that it is the one for these servos",
    "current": "check whether something blocks the joint; a reset switches its torque off and on",
    "load": "check whether something blocks or loads the joint; a reset switches its torque off and on",
    "torque": "check the power supply and the servo's cable; a reset configures the servo and switches its torque on",
}
_TEMPERATURE_MARGIN, _VOLTAGE_MARGIN, _LOAD_MARGIN = 2.0, 0.2, 0.05
"""Hysteresis: how far a value must return within its level to end a condition [deg C, V, of full torque]."""


@attrs.frozen(eq=False)
class Measured:
    """One health reading of all servos; arrays of shape (S,)."""

    temperature: Vector
    """[deg C]"""
    voltage: Vector
    """[V]"""
    load: Vector
    """Load from `SteadyLoad`, as a fraction of full torque."""
    torque: NDArray[np.bool_] | None
    """Whether the torque is on; None if it should be off."""


@attrs.frozen
class _Level:
    """A level at which a condition begins."""

    name: str
    """Name of the option, or of the servos' register."""
    value: float
    severity: Severity = Severity.FAULT


class SteadyLoad:
    """The minimum load of each joint over a period, which excludes short loads such as acceleration.

    Args:
        size: number of joints.
        period_ns: length of a period [ns].
    """

    def __init__(self, size: int, period_ns: int) -> None:
        self._size, self._period_ns = size, period_ns
        self.begin(0)

    def begin(self, now_ns: int) -> None:
        """Discard earlier loads and begin a period."""
        self._least = np.full(self._size, np.inf)
        self._held: Vector = np.zeros(self._size)
        self._end_ns = now_ns + self._period_ns

    def add(self, load: Vector, measured: NDArray[np.bool_]) -> None:
        """Add loads [of full torque], shape (J,), where `measured` is true."""
        self._least = np.where(measured, np.minimum(self._least, np.abs(load)), self._least)

    def held(self, now_ns: int) -> Vector:
        """Minimum load in the last complete period, shape (J,); 0 where nothing was measured."""
        if now_ns >= self._end_ns:
            held = np.where(np.isfinite(self._least), self._least, 0.0)
            self.begin(now_ns)
            self._held = held
        return self._held


type _Key = tuple[int, str]
"""Index of a servo, and quantity."""


class Health:
    """Present conditions of the joints.

    Damage that a packet's checksum does not detect must not stop the robot. So an error counts only if it is reported
    twice, and a value only if the next reading confirms it.

    Args:
        options: options with the levels.
        joints: joint names.
        place: index of a servo -> its place, for messages.
    """

    def __init__(self, options: FollowerOptions, joints: Sequence[str], place: Callable[[int], Place]) -> None:
        self._options = options
        self._joints = joints
        self._place = place
        self._gentle = np.array([joint in options.gentle for joint in joints])
        self._supplies: Sequence[Supply] = ()
        self.reset()

    def begin(self, supplies: Sequence[Supply]) -> None:
        """Start with a connected arm, whose S servos have these supplies."""
        self._supplies = supplies
        self.reset()

    def reset(self) -> None:
        """Clear all conditions, after a reset of faults."""
        self._reported = np.zeros(len(self._joints), dtype=np.uint8)
        self._errors = np.zeros(len(self._joints), dtype=np.uint8)
        self._suspected: dict[_Key, Condition] = {}
        self._measured: dict[_Key, Condition] = {}
        self._from_errors: dict[_Key, Condition] = {}
        self.conditions: tuple[Condition, ...] = ()

    @property
    def faulty(self) -> bool:
        """Whether any condition is a fault."""
        return any(condition.severity is Severity.FAULT for condition in self.conditions)

    def report(self, errors: NDArray[np.uint8], answered: NDArray[np.bool_]) -> None:
        """Process the error bytes of one reading, shape (S,), where `answered` is true."""
        before = self._reported
        self._reported = np.where(answered, errors, before)
        lasting = (self._reported & before) | (self._errors & (self._reported | before))
        if (lasting != self._errors).any():
            self._errors = lasting
            self._from_errors = {
                key: condition for index in np.flatnonzero(lasting) for key, condition in self._reports(int(index))
            }
            self._collect()

    def measure(self, measured: Measured) -> bool:
        """Process a health reading; returns whether to read again soon, to confirm a new condition."""
        conditions = dict(self._found(measured))
        known, suspected = self._measured, self._suspected
        true = {
            key: condition
            for key, condition in conditions.items()
            if _as_severe(suspected.get(key), condition.severity) or _as_severe(known.get(key), condition.severity)
        }
        self._measured = {key: known[key] for key in known if key in conditions} | true
        self._suspected = conditions
        self._collect()
        return len(true) < len(conditions)

    def _collect(self) -> None:
        self.conditions = tuple({**self._measured, **self._from_errors}.values())

    def _reports(self, index: int) -> list[tuple[_Key, Condition]]:
        code = int(self._errors[index])
        return [((index, _quantity(bit)), self._error(index, bit)) for bit in range(8) if code >> bit & 1]

    def _error(self, index: int, bit: int) -> Condition:
        quantity, name = _quantity(bit), faults(1 << bit)[0]
        if 1 << bit == OVERLOAD and self._gentle[index]:
            message = (
                f"{self._place(index)}: the servo is in overload and holds on with its protective torque; the run "
                "continues; release the grasp for a moment to let the motor cool"
            )
            return Condition(self._joints[index], quantity, 1.0, "", Severity.WARNING, message)
        message = f"{self._place(index)}: the servo reports {name}; {_REMEDIES.get(quantity, 'replace the servo')}"
        sheds = quantity in _LIGHTER
        return Condition(self._joints[index], quantity, 1.0, "", Severity.FAULT, message, sheds_load=sheds)

    def _found(self, measured: Measured) -> list[tuple[_Key, Condition]]:
        conditions = []
        for index in range(len(self._joints)):
            for condition in (
                self._temperature(index, float(measured.temperature[index])),
                self._voltage(index, float(measured.voltage[index])),
                self._load(index, float(measured.load[index])),
                self._torque(index, measured.torque),
            ):
                if condition is not None:
                    conditions.append(((index, condition.quantity), condition))
        return conditions

    def _temperature(self, index: int, value: float) -> Condition | None:
        options = self._options
        levels = _levels("temperature", options.max_temperature, options.warning_temperature)
        return self._beyond(index, "temperature", value, "deg C", levels, _TEMPERATURE_MARGIN)

    def _load(self, index: int, value: float) -> Condition | None:
        if self._gentle[index]:
            return None  # such a joint is made to grip, and its servo protects itself
        levels = _levels("load", self._options.max_load, self._options.warning_load)
        return self._beyond(index, "load", value, "", levels, _LOAD_MARGIN)

    def _voltage(self, index: int, value: float) -> Condition | None:
        supply, options = self._supplies[index], self._options
        too_high = (_Level("max_voltage_limit", supply.greatest),)
        too_low = (
            _Level("min_voltage_limit", supply.least),
            _Level("max_voltage_drop", (1 - options.max_voltage_drop) * supply.measured),
            _Level("warning_voltage_drop", (1 - options.warning_voltage_drop) * supply.measured, Severity.WARNING),
        )
        return self._beyond(index, "voltage", value, "V", too_high, _VOLTAGE_MARGIN) or self._beyond(
            index, "voltage", value, "V", too_low, _VOLTAGE_MARGIN, sign=-1
        )

    def _torque(self, index: int, torque: NDArray[np.bool_] | None) -> Condition | None:
        if torque is None or torque[index]:
            return None
        message = (
            f"{self._place(index)}: its torque went off by itself, as after a loss of power (brown-out); "
            f"{_REMEDIES['torque']}"
        )
        return Condition(self._joints[index], "torque", 0.0, "", Severity.FAULT, message)

    def _beyond(
        self, index: int, quantity: str, value: float, unit: str, levels: Sequence[_Level], margin: float, sign: int = 1
    ) -> Condition | None:
        """The condition of a value beyond one of `levels`, sorted from worst to mildest; None if it is within all.

        To end a condition, the value must return by `margin`. `sign` is -1 if smaller values are worse.
        """
        known = self._measured.get((index, quantity))
        for level in levels:
            slack = margin if _as_severe(known, level.severity) else 0.0
            if sign * (value - level.value) > -slack:
                side = "above" if sign > 0 else "below"
                says = unit or "of full torque"
                what = f"{quantity} {value:.3g} {says}, {side} {level.name} ({level.value:.3g} {says})"
                return Condition(
                    self._joints[index], quantity, value, unit, level.severity,
                    f"{self._place(index)}: {what}; {_REMEDIES[quantity]}", sheds_load=quantity in _LIGHTER,
                )  # fmt: skip
        return None


def _quantity(bit: int) -> str:
    return _QUANTITIES.get(bit, faults(1 << bit)[0])


def _levels(quantity: str, most: float, warning: float) -> tuple[_Level, _Level]:
    return _Level(f"max_{quantity}", most), _Level(f"warning_{quantity}", warning, Severity.WARNING)


def _as_severe(known: Condition | None, severity: Severity) -> bool:
    """Whether the known condition is at least that severe."""
    return known is not None and (known.severity is Severity.FAULT or severity is Severity.WARNING)

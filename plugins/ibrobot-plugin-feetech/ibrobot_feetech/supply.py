"""Checks whether the supply voltage is within the limits of the servos."""

from __future__ import annotations

import attrs

from ibrobot_core.api import HardwareError
from ibrobot_feetech.bus import FeetechBus

_VOLTS = 0.1


@attrs.frozen
class Supply:
    """The voltage that a servo measures, and its limits [V]."""

    measured: float
    least: float
    greatest: float

    @property
    def fits(self) -> bool:
        """Whether the voltage is within the limits."""
        return self.least <= self.measured <= self.greatest

    @property
    def limits(self) -> str:
        """The limits as text."""
        return f"{self.least:.1f} to {self.greatest:.1f} V"

    @property
    def remedy(self) -> str:
        """The remedy if the voltage is outside the limits."""
        if self.measured > self.greatest:
            return "unplug it now: a servo for 7.4 V does not last on 12 V; give it its own supply"
        return "check the supply, its plug, and whether it is strong enough for all servos"


def supply(bus: FeetechBus, servo: int) -> Supply:
    """Read a servo's supply voltage and its limits.

    Raises:
        FeetechError: if the servo does not answer.
    """
    names = ("present_voltage", "min_voltage_limit", "max_voltage_limit")
    return Supply(*(bus.read_faulty(servo, name) * _VOLTS for name in names))


def check_supply(bus: FeetechBus, servo: int) -> None:
    """Check that a servo's supply is within its limits.

    Raises:
        HardwareError: if it is not; with the measured voltage and the limits.
        FeetechError: if the servo does not answer.
    """
    volts = supply(bus, servo)
    if not volts.fits:
        place = bus.place(servo, "present_voltage")
        raise HardwareError(
            f"{place}: it measures {volts.measured:.1f} V, and is made for {volts.limits}; {volts.remedy}"
        )

"""Whether the servos of an arm can stand the voltage that they are given."""

from __future__ import annotations

import attrs

from ibrobot_core.api import HardwareError
from ibrobot_feetech.bus import FeetechBus

_VOLTS = 0.1


@attrs.frozen
class Supply:
    """What a servo measures, and what it is made for [V]."""

    measured: float
    least: float
    greatest: float

    @property
    def fits(self) -> bool:
        """Whether it may stay on."""
        return self.least <= self.measured <= self.greatest

    @property
    def limits(self) -> str:
        """As text."""
        return f"{self.least:.1f} to {self.greatest:.1f} V"

    @property
    def remedy(self) -> str:
        """What to do where it does not fit."""
        if self.measured > self.greatest:
            return "unplug it now: a servo for 7.4 V does not last on 12 V; give it its own supply"
        return "check the supply, its plug, and whether it is made for that many servos"


def supply(bus: FeetechBus, servo: int) -> Supply:
    """What a servo says of its supply.

    Raises:
        FeetechError: when it does not answer.
    """
    names = ("present_voltage", "min_voltage_limit", "max_voltage_limit")
    return Supply(*(bus.read_faulty(servo, name) * _VOLTS for name in names))


def check_supply(bus: FeetechBus, servo: int) -> None:
    """Check that a servo's supply is within its limits.

    Raises:
        HardwareError: with the measured voltage and the limits.
        FeetechError: when it does not answer.
    """
    found = supply(bus, servo)
    if not found.fits:
        place = bus.place(servo, "present_voltage")
        raise HardwareError(
            f"{place}: it measures {found.measured:.1f} V, and is made for {found.limits}; {found.remedy}"
        )

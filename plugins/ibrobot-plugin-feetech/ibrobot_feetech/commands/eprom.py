"""Writing what servos keep without power."""

from __future__ import annotations

from collections.abc import Mapping

from ibrobot_feetech.bus import FeetechBus
from ibrobot_feetech.errors import FeetechError


def write_eprom(bus: FeetechBus, servo: int, values: Mapping[str, int]) -> None:
    """Set registers of a servo's EPROM, torque off, and see that it kept them.

    Raises:
        FeetechError: when it did not take one.
    """
    bus.write(servo, "torque_enable", 0)
    bus.write(servo, "lock", 0)
    try:
        for name, value in values.items():
            bus.write(servo, name, value)
    finally:
        bus.write(servo, "lock", 1)
    for name, value in values.items():
        if (found := bus.read(servo, name)) != value:
            raise FeetechError(bus.place(servo, name), f"it was set to {value} and reads {found}")

"""The plugin's hooks: teleop `imu`, and the serial ports for doctor."""

from __future__ import annotations

from collections.abc import Iterable

from ibrobot_core.api import Check, Late, TeleopDescriptor, hookimpl
from ibrobot_imu.options import ImuOptions


@hookimpl
def ibrobot_teleop() -> Iterable[TeleopDescriptor]:
    """The teleop `imu`."""
    yield TeleopDescriptor(
        type="imu",
        options=ImuOptions,
        make=Late("ibrobot_imu.teleop:ImuTeleop"),
        label="drive by tilting a sensor",
        summary="moves the tool by the tilt of an orientation sensor (BNO08x, WitMotion)",
    )


@hookimpl
def ibrobot_doctor() -> Iterable[Check]:
    """Check which serial ports the user may open."""
    from ibrobot_imu.permissions import checks

    yield from checks()

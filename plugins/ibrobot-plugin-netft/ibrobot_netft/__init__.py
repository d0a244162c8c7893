"""The plugin's hooks: sensor `netft`, and `ibrobot netft emulate`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import attrs

from ibrobot_core.api import Late, Options, SensorDescriptor, documented, hookimpl, not_empty, option
from ibrobot_core.app import Command


@documented
@attrs.frozen
class NetFtOptions(Options):
    """Options of `type: netft`: a force-torque sensor that streams over Ethernet."""

    host: str = option(validator=not_empty, help="address of the sensor, e.g. 192.168.1.1")
    port: int = option(49152, ge=1, le=65535, help="UDP port of the sensor")
    counts_per_force: float = option(
        1_000_000.0, unit="1/N", gt=0, help="counts of a newton, which the sensor's own page shows"
    )
    counts_per_torque: float = option(
        1_000_000.0, unit="1/(N m)", gt=0, help="counts of a newton metre, which the sensor's own page shows"
    )
    frame: str = option("", help="frame of the measured wrench; NAME_frame if empty")
    silence: float = option(1.0, unit="s", gt=0, help="time without a record after which the sensor counts as gone")

    def devices(self) -> Mapping[str, str]:
        """The sensor."""
        return {"host": f"{self.host}:{self.port}"}


@hookimpl
def ibrobot_sensors() -> Iterable[SensorDescriptor]:
    """A force-torque sensor."""
    yield SensorDescriptor(
        type="netft",
        kind="force",
        options=NetFtOptions,
        make=Late("ibrobot_netft.sensor:NetFt"),
        summary="force-torque sensor with ATI's Net F/T protocol",
        topic="/force/{name}/wrench",
        message="geometry_msgs/msg/WrenchStamped",
    )


@hookimpl
def ibrobot_commands() -> Iterable[Command]:
    """`ibrobot netft emulate`."""
    yield Command("netft", summary="Emulate a force-torque sensor.")
    yield Command("netft emulate", Late("ibrobot_netft.emulator:Emulate"))

"""Options of arms with Damiao motors."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

import attrs

from ibrobot_core.api import OptionFault, Options, did_you_mean, documented, not_empty, option
from ibrobot_damiao.protocol import DEFAULT_BITRATE, MAX_KD, MAX_KP

if TYPE_CHECKING:
    from ibrobot_core.api import Robot


@documented
@attrs.frozen
class MotorOptions:
    """A motor."""

    id: int = option(ge=1, le=0x7E, help="CAN id")
    kp: float = option(
        20.0, unit="Nm/rad", gt=0, le=MAX_KP, help="stiffness: an arm that sags under its weight needs more"
    )
    kd: float = option(1.0, unit="Nm s/rad", ge=0, le=MAX_KD, help="damping: more of it lets the joint lag")
    inverted: bool = option(False, help="whether the joint's angle decreases as the motor's increases")
    zero: float = option(0.0, unit="rad", help="angle of the joint where the motor's position is 0")


@documented
@attrs.frozen
class DamiaoOptions(Options):
    """Options of `type: damiao`: an arm whose joints are Damiao motors on one CAN bus, in MIT mode."""

    channel: str = option(
        validator=not_empty,
        help="CAN bus: a network interface, e.g. can0, or the serial port of an adapter that speaks slcan",
    )
    motors: Mapping[str, MotorOptions] = option(help="joint -> id, kp, kd, inverted and zero of its motor")
    interface: str = option("", help="interface type of python-can; by default socketcan, or slcan for a serial port")
    bitrate: int = option(
        DEFAULT_BITRATE, unit="bit/s", gt=0, le=8_000_000, help="rate of the bus; socketcan takes it from ip link"
    )
    data_bitrate: int | None = option(
        None,
        unit="bit/s",
        gt=0,
        le=8_000_000,
        help="rate of the data in CAN FD frames; without it, frames are classic ones",
    )
    lost_replies: int = option(
        3, unit="ticks", ge=0, le=1000, help="consecutive replies of a motor that may be missing"
    )
    retries: int = option(2, ge=0, le=100, help="retries of requests outside the control loop")
    warning_temperature: float = option(70.0, unit="deg C", gt=0, le=150, help="a motor above it causes a warning")
    max_temperature: float = option(90.0, unit="deg C", gt=0, le=150, help="a motor above it causes a fault")

    def check(self, robot: Robot, joints: tuple[str, ...]) -> Iterator[OptionFault]:
        """Check that each joint has a motor, and each motor a joint and an id of its own."""
        for joint in self.motors:
            if joint not in joints:
                yield OptionFault(("motors", joint), f"unknown joint {joint!r}{did_you_mean(joint, joints, 'known')}")
        if missing := [joint for joint in joints if joint not in self.motors]:
            yield OptionFault(("motors",), f"no motor for joint {missing[0]!r}; give it one: {missing[0]}: {{id: ID}}")
        owners: dict[int, str] = {}
        for joint, motor in self.motors.items():
            if (owner := owners.setdefault(motor.id, joint)) != joint:
                yield OptionFault(("motors", joint, "id"), f"motor {motor.id} belongs to {owner} already")

    def devices(self) -> Mapping[str, str]:
        """The bus, which one component has at a time: a network interface, or the resolved path of a port."""
        return {"channel": os.path.realpath(self.channel) if self.channel.startswith("/") else self.channel}

"""Errors of a Feetech bus; each names the port, servo and register, and what to check."""

from __future__ import annotations

from typing import ClassVar

import attrs

from ibrobot_core.api import HardwareError


@attrs.frozen
class Place:
    """The place of an error on a bus."""

    port: str
    servo: int | None = None
    joint: str | None = None
    register: str | None = None

    def __str__(self) -> str:
        parts = [self.port]
        if self.servo is not None:
            parts.append(f"servo {self.servo}" + (f" ({self.joint})" if self.joint else ""))
        if self.register is not None:
            parts.append(self.register)
        return ", ".join(parts)


class FeetechError(HardwareError):
    """Base of the errors of a servo bus.

    Args:
        place: port, servo and register.
        what: the problem, with values.
    """

    check: ClassVar[str] = "`ibrobot feetech monitor` shows what the servos report"
    """What the user should check."""

    def __init__(self, place: Place, what: str) -> None:
        self.place = place
        super().__init__(f"{place}: {what}; {self.check}")


class PortError(FeetechError):
    """A serial port cannot be opened or has disappeared, e.g. because of an unplugged cable."""

    check = "check the USB cable; `ibrobot feetech find-port` lists the available ports"


class PortForbidden(PortError):
    """The user has no permission to open a port."""

    check = "add yourself to the group that owns it, e.g. `sudo usermod -aG dialout $USER`, and log in again"


class PortHeld(PortError):
    """Another program has the port open."""

    check = "close that program (another `ibrobot`, LeRobot, a serial monitor); `fuser -v PORT` names it"


class NoReply(FeetechError):
    """A servo did not answer in time, after all retries."""

    check = "check its power, cable, id and baud rate; `ibrobot feetech scan` shows which servos answer"


class PacketError(FeetechError):
    """The received bytes are not a valid packet, e.g. because of a wrong checksum."""

    check = "check the cable, its ground, and that no two servos share an id"


class UnexpectedReply(FeetechError):
    """A valid packet does not answer the request, e.g. because it is from another servo or has another length."""

    check = "check that no other program uses the port and that no two servos share an id"


class EpromLocked(FeetechError):
    """A write to locked EPROM, which the servo would lose."""

    check = "set `lock` to 0 first, and to 1 afterwards"


class TorqueStaysOn(FeetechError):
    """A servo still reports torque after it was switched off."""

    check = "cut its power before you touch the arm"


class ServoFault(FeetechError):
    """A servo reports an error, e.g. overheating; `faults` lists them."""

    check = "check its supply, its load and its temperature, then switch its torque off and on"

    def __init__(self, place: Place, faults: tuple[str, ...]) -> None:
        self.faults = faults
        super().__init__(place, f"the servo reports {', '.join(faults)}")

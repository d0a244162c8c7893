"""What can go wrong on a Feetech bus; every error names the port, the servo, the register and what to check."""

from __future__ import annotations

from typing import ClassVar

import attrs

from ibrobot_core.api import HardwareError


@attrs.frozen
class Place:
    """Where on a bus something went wrong."""

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
        place: where.
        what: what happened, with the values.
    """

    check: ClassVar[str] = "`ibrobot feetech monitor` shows what the servos report"
    """What to look at."""

    def __init__(self, place: Place, what: str) -> None:
        self.place = place
        super().__init__(f"{place}: {what}; {self.check}")


class PortError(FeetechError):
    """A serial port that cannot be opened or is gone, e.g. an unplugged cable."""

    check = "check the USB cable; `ibrobot feetech find-port` lists the ports that are there"


class PortForbidden(PortError):
    """A port that this user may not open."""

    check = "add yourself to the group that owns it, e.g. `sudo usermod -aG dialout $USER`, and log in again"


class PortHeld(PortError):
    """A port that another program has open."""

    check = "end that program (another `ibrobot`, LeRobot, a serial monitor); `fuser -v PORT` names it"


class NoReply(FeetechError):
    """A servo that did not answer in time, after all retries."""

    check = "check its power, the cable to it, its id and the baud rate; `ibrobot feetech scan` shows who answers"


class PacketError(FeetechError):
    """Bytes that are no valid packet, e.g. one with a wrong checksum."""

    check = "check the cable, its ground, and that no two servos share an id"


class UnexpectedReply(FeetechError):
    """A valid packet that does not answer the request, e.g. one of another servo or length."""

    check = "check that no other program uses the port and that no two servos share an id"


class EpromLocked(FeetechError):
    """A write to EPROM that the servo would not keep."""

    check = "set `lock` to 0 first, and to 1 afterwards"


class TorqueStaysOn(FeetechError):
    """A servo whose torque was taken off and that says it is on."""

    check = "cut its power before you touch the arm"


class ServoFault(FeetechError):
    """A servo that reports an error of its own, e.g. overheating; `faults` names them."""

    check = "check its supply, its load and its temperature, then take its torque off and on"

    def __init__(self, place: Place, faults: tuple[str, ...]) -> None:
        self.faults = faults
        super().__init__(place, f"the servo reports {', '.join(faults)}")

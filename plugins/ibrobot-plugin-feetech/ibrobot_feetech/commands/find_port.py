"""`ibrobot feetech find-port`: finds the port of an arm."""

from __future__ import annotations

from collections.abc import Sequence

import attrs
from ibrobot_terminal import Guide

from ibrobot_core.api import HardwareError, option
from ibrobot_feetech.commands.dialogue import TerminalGuide
from ibrobot_feetech.usb import BY_SERIAL, UsbPort, usb_ports


@attrs.frozen(kw_only=True)
class FindPort:
    """Find the port of an arm by unplugging its USB cable."""

    only_list: bool = option(False, typed="--list", help="only list the ports")

    def __call__(self) -> None:
        guide = TerminalGuide()
        before = list_ports(guide)
        if not self.only_list:
            find_arm(guide, before)


def list_ports(guide: Guide) -> list[UsbPort]:
    """Show the USB serial ports, and return them."""
    ports = usb_ports()
    for port in ports:
        _show(guide, port)
    if not ports:
        guide.say("There is no USB serial port.")
    return ports


def find_arm(guide: Guide, before: Sequence[UsbPort]) -> None:
    """Find the port of an arm with an operator, who unplugs it and plugs it in again.

    Raises:
        HardwareError: if no port appears, or several do.
    """
    guide.wait("Unplug the arm's USB cable, if it is plugged in.", flag="--list")
    without = {port.path for port in usb_ports()}
    gone = [port for port in before if port.path not in without]
    if len(gone) > 1:
        raise HardwareError(f"several ports are gone: {', '.join(p.path for p in gone)}; unplug one cable at a time")
    guide.wait("Plug it in (again).", flag="--list")
    # The number in the path may have changed.
    new = [port for port in usb_ports() if port.path not in without]
    if not new:
        raise HardwareError("no port appeared; check the cable (some only charge) and the arm's board")
    if len(new) > 1:
        raise HardwareError(f"several ports appeared: {', '.join(p.path for p in new)}; plug in one arm at a time")
    guide.say("\nThe arm is at:")
    _show(guide, new[0])


def _show(guide: Guide, port: UsbPort) -> None:
    arm = " (an SO-101's adapter)" if port.is_arm else ""
    number = f", serial number {port.serial_number}" if port.serial_number else ""
    guide.say(f"{port.path}  {port.description}, USB {port.usb_id}{number}{arm}")
    if stays := port.stable or (port.serial_number and f"{BY_SERIAL}{port.serial_number}"):
        guide.say(f"    better for a YAML, because it does not change: {stays}")
    if not port.permitted:
        guide.say("    no permission: sudo usermod -aG dialout $USER, then log in again")

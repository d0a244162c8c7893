"""USB serial adapters: lists ports, and checks that an arm uses the adapter with which it was calibrated."""

from __future__ import annotations

import os
from pathlib import Path

import attrs
from ibrobot_calibration import Calibration
from serial.tools import list_ports

from ibrobot_core.api import HardwareError

ADAPTER_VENDOR = 0x1A86
"""USB vendor id of the CH340 and CH343 on the SO-101's boards."""
_BY_ID = Path("/dev/serial/by-id")
BY_SERIAL = "serial:"
"""What a port begins with that names its adapter by the USB serial number."""
GIVE = "give that port, or `port: serial:{}`, which finds it wherever it is"


@attrs.frozen
class UsbPort:
    """A serial port behind USB."""

    path: str
    description: str
    usb_id: str
    """Vendor and product, e.g. `1a86:55d3`."""
    serial_number: str
    """Serial number of the adapter; empty if it has none."""
    stable: str
    """A path that stays the same after replugging; empty if there is none."""

    @property
    def is_arm(self) -> bool:
        """Whether the adapter is of the type on the SO-101's boards."""
        return self.usb_id.startswith(f"{ADAPTER_VENDOR:04x}:")

    @property
    def permitted(self) -> bool:
        """Whether the user may open it."""
        return os.access(self.path, os.R_OK | os.W_OK)


def usb_ports() -> list[UsbPort]:
    """All USB serial ports, sorted by path."""
    links = {str(link.resolve()): str(link) for link in _BY_ID.iterdir()} if _BY_ID.is_dir() else {}
    return [
        UsbPort(
            port.device,
            port.description,
            f"{port.vid:04x}:{port.pid:04x}",
            port.serial_number or "",
            links.get(port.device, ""),
        )
        for port in sorted(list_ports.comports())
        if port.vid is not None
    ]


def find_port(port: str) -> str:
    """The path of a port in a robot YAML: a path, or `serial:` with the USB serial number of the adapter.

    Raises:
        HardwareError: if no adapter has this serial number; names those that are plugged in.
    """
    if not port.startswith(BY_SERIAL):
        return port
    there = usb_ports()
    for each in there:
        if each.serial_number == port.removeprefix(BY_SERIAL):
            return each.stable or each.path
    known = ", ".join(f"{BY_SERIAL}{each.serial_number} at {each.path}" for each in there if each.serial_number)
    raise HardwareError(f"no USB adapter with this serial number is plugged in; there is {known or 'none with one'}")


def adapter_elsewhere(calibration: Calibration) -> UsbPort | None:
    """Where the adapter is with which a calibration was made; None if it is unknown, or not plugged in."""
    if not calibration.adapter:
        return None
    return next((each for each in usb_ports() if each.serial_number == calibration.adapter), None)


def usb_port(path: str) -> UsbPort | None:
    """The USB port at a path or symbolic link; None if it is not a USB port."""
    try:
        real = str(Path(find_port(path)).resolve())
    except HardwareError:
        return None
    return next((each for each in usb_ports() if each.path == real), None)


def check_adapter(calibration: Calibration, port: str) -> None:
    """Check that the adapter at a port is the one with which the calibration was made, if both are known.

    Raises:
        HardwareError: if it is another one, e.g. because the ports of leader and follower are swapped.
    """
    adapter = usb_port(port)
    if not calibration.adapter or adapter is None or adapter.serial_number == calibration.adapter:
        return
    there = (
        f"has the USB serial number {adapter.serial_number}" if adapter.serial_number else "has no USB serial number"
    )
    elsewhere = adapter_elsewhere(calibration)
    where = ""
    if elsewhere is not None:
        where = f", which is at {elsewhere.stable or elsewhere.path}: {GIVE.format(calibration.adapter)}"
    raise HardwareError(
        f"{port}: this is another arm: its adapter {there}, {calibration.path} was made with "
        f"{calibration.adapter}{where}; are the ports of leader and follower swapped? If the adapter was replaced, "
        f"`ibrobot feetech import {calibration.path} --port {port} --yes` stores the new one"
    )

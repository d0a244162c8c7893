"""Serial ports of this machine, and which of them an arm is on."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import attrs
import click
from serial.tools import list_ports

from ibrobot_core.errors import HardwareError
from ibrobot_feetech.bus import FeetechBus

ADAPTER_VENDOR = 0x1A86
"""USB vendor of the CH340 and CH343 on the SO-101's boards."""
_RETRIES = 5
"""Nothing here is in a hurry."""
_BY_ID = Path("/dev/serial/by-id")


@attrs.frozen
class UsbPort:
    """A serial port behind USB."""

    path: str
    description: str
    usb_id: str
    """Vendor and product, e.g. `1a86:55d3`."""
    serial_number: str
    """Of the adapter; empty where it has none."""
    stable: str
    """A path that stays the same over replugging; empty where there is none."""

    @property
    def is_arm(self) -> bool:
        """Whether the adapter is of the kind on the SO-101's boards."""
        return self.usb_id.startswith(f"{ADAPTER_VENDOR:04x}:")

    @property
    def permitted(self) -> bool:
        """Whether this user may open it."""
        return os.access(self.path, os.R_OK | os.W_OK)


def usb_ports() -> list[UsbPort]:
    """All of them, by path."""
    links = {str(link.resolve()): str(link) for link in _BY_ID.iterdir()} if _BY_ID.is_dir() else {}
    return [
        UsbPort(
            port.device, port.description, f"{port.vid:04x}:{port.pid:04x}", port.serial_number or "",
            links.get(port.device, ""),
        )
        for port in sorted(list_ports.comports())
        if port.vid is not None
    ]  # fmt: skip


def the_port(port: str | None) -> str:
    """The port that was given, or the only one that an arm can be on.

    Raises:
        HardwareError: when there are none or several.
    """
    if port is not None:
        return port
    arms = [found.stable or found.path for found in usb_ports() if found.is_arm]
    if not arms:
        raise HardwareError(
            f"no port given, and no adapter of an SO-101 (USB id {ADAPTER_VENDOR:04x}) is plugged in; "
            "check the USB cable, or give PORT"
        )
    if len(arms) > 1:
        raise HardwareError(f"no port given, and there are several arms: {', '.join(arms)}; give PORT")
    click.echo(f"port: {arms[0]}", err=True)
    return arms[0]


def adapter_serial_number(port: str) -> str:
    """Of the adapter at that port; empty where there is none."""
    path = str(Path(port).resolve())
    return next((found.serial_number for found in usb_ports() if found.path == path), "")


def port_argument[F: Callable[..., Any]](command: F) -> F:
    """Adds the argument PORT."""
    return click.argument("port", required=False)(command)


@contextmanager
def opened(
    port: str | None, baud_rate: int = 1_000_000, joints: Mapping[int, str] | None = None
) -> Iterator[FeetechBus]:
    """An open bus at the port that was given, or at the only one that can be meant.

    Raises:
        HardwareError: when it cannot be opened.
    """
    bus = FeetechBus(the_port(port), baud_rate=baud_rate, joints=joints, retries=_RETRIES)
    bus.open()
    try:
        yield bus
    finally:
        bus.close()

"""Permissions of the user to open serial ports, and the udev rule that grants them."""

from __future__ import annotations

import os
from collections.abc import Iterator

from serial.tools import list_ports

from ibrobot_core.api import Check

RULES = "/etc/udev/rules.d/70-ibrobot-imu.rules"
"""Must sort before 73-seat-late.rules, which gives devices tagged `uaccess` to the user logged in at the machine."""


def udev_rule(vendor: int) -> str:
    """The rule that lets users open the serial adapters of a vendor."""
    return f'SUBSYSTEM=="tty", ATTRS{{idVendor}}=="{vendor:04x}", TAG+="uaccess"'


def checks() -> Iterator[Check]:
    """A check for each serial port behind USB."""
    for port in sorted(list_ports.comports()):
        if port.vid is not None:
            allowed = os.access(port.device, os.R_OK | os.W_OK)
            text = f"{port.description} at {port.device}"
            remedy = f"echo '{udev_rule(port.vid)}' | sudo tee {RULES} && sudo udevadm control --reload, then replug it"
            yield Check("imu port", allowed, text if allowed else f"{text}: no permission", remedy)

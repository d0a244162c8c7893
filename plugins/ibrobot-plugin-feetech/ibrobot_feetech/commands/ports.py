"""The argument PORT, and the port where it is left out."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import click

from ibrobot_core.api import HardwareError, echo, wrong_input
from ibrobot_feetech.bus import FeetechBus
from ibrobot_feetech.usb import ADAPTER_VENDOR, usb_ports

_RETRIES = 5
"""Nothing here is in a hurry."""


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
    echo(f"port: {arms[0]}", err=True)
    return arms[0]


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
    with wrong_input():
        bus = FeetechBus(the_port(port), baud_rate=baud_rate, joints=joints, retries=_RETRIES)
        bus.open()
    try:
        yield bus
    finally:
        bus.close()

"""The argument PORT, and the port to use if it is omitted."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import attrs

from ibrobot_core.api import HardwareError, option
from ibrobot_core.app import echo, wrong_input
from ibrobot_feetech.bus import FeetechBus
from ibrobot_feetech.usb import ADAPTER_VENDOR, usb_ports

_RETRIES = 5
"""Retries of the commands, which have no deadline."""
_PATIENCE_S = 0.05
"""How much longer than a control loop the commands wait for a reply [s]."""


def the_port(port: str | None) -> str:
    """The given port, or the only port with an SO-101 adapter.

    Raises:
        HardwareError: if no port is given, and none or several have such an adapter.
    """
    if port is not None:
        return port
    arms = [adapter.stable or adapter.path for adapter in usb_ports() if adapter.is_arm]
    if not arms:
        raise HardwareError(
            f"no port given, and no adapter of an SO-101 (USB id {ADAPTER_VENDOR:04x}) is plugged in; "
            "check the USB cable, or give PORT"
        )
    if len(arms) > 1:
        raise HardwareError(f"no port given, and there are several arms: {', '.join(arms)}; give PORT")
    echo(f"port: {arms[0]}", err=True)
    return arms[0]


@attrs.frozen(kw_only=True)
class OnPort:
    """The argument PORT."""

    port: str | None = option(None, typed="PORT", help="serial port; by default that of the only adapter")


@contextmanager
def opened(
    port: str | None,
    baud_rate: int = 1_000_000,
    joints: Mapping[int, str] | None = None,
    patience_s: float = _PATIENCE_S,
) -> Iterator[FeetechBus]:
    """Open a bus at the given port, or at the only port with an SO-101 adapter.

    Raises:
        HardwareError: if it cannot be opened.
    """
    with wrong_input():
        bus = FeetechBus(the_port(port), baud_rate=baud_rate, joints=joints, retries=_RETRIES, patience_s=patience_s)
        bus.open()
    try:
        yield bus
    finally:
        bus.close()

"""Names and addresses of this machine."""

from __future__ import annotations

import ipaddress
import re
import socket
from collections.abc import Sequence
from typing import Any

_LABEL = "[A-Za-z0-9]([A-Za-z0-9-]*[A-Za-z0-9])?"
_NAME = re.compile(rf"{_LABEL}(\.{_LABEL})*")
LOCAL = ("127.0.0.1", "localhost", "::1")
"""Names and addresses of this machine that no other machine can use."""


def is_loopback(host: str) -> bool:
    """Whether an address is reachable from this machine alone."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def check_name(instance: Any, attribute: Any, value: str) -> None:
    """Check that an option is a host name or an address; a validator of attrs.

    Raises:
        ValueError: if it is neither.
    """
    try:
        ipaddress.ip_address(value)
    except ValueError:
        if not _NAME.fullmatch(value) or re.fullmatch(r"[0-9.]+", value):
            raise ValueError(f"{value!r} is not a host name or an address, e.g. robot.lab or 192.168.1.5") from None


def host_names(host: str, further: Sequence[str] = ()) -> tuple[str, ...]:
    """Names and addresses under which browsers may reach a server.

    Args:
        host: the address on which the server listens.
        further: other names of this machine.

    Returns:
        The names; the first is that of the printed address.
    """
    if is_loopback(host):
        own = LOCAL
    else:
        name = socket.gethostname().lower()
        own = (*(() if host in ("0.0.0.0", "::") else (host,)), name, f"{name}.local")
    return tuple(dict.fromkeys((*own, *further, *LOCAL)))


def network_address() -> str | None:
    """The address from which this machine reaches other networks; None without one. Sends nothing."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # an address for documentation, RFC 5737
        except OSError:
            return None
        return str(probe.getsockname()[0])

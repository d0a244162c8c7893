"""One page for all devices of a run with the same address, e.g. of two arms, or of several modes."""

from __future__ import annotations

import threading
from io import StringIO

import attrs
import segno

from ibrobot_core.api import Context, TeleopError
from ibrobot_core.app import echo
from ibrobot_webxr.options import WebxrOptions
from ibrobot_webxr.server import PageServer

_SHARED = ("names", "certificate", "key", "cameras", "image_rate")
"""Options of the page, which its devices must agree on."""


@attrs.define
class _Shared:
    server: PageServer
    options: WebxrOptions
    device: str
    """The device that opened it."""
    users: int = 0


_lock = threading.Lock()
_open: dict[tuple[int, str, int], _Shared] = {}
"""Bus of the run, host and port -> the page."""


def _key(options: WebxrOptions, ctx: Context) -> tuple[int, str, int]:
    return id(ctx.bus), options.host, options.port


def open_page(options: WebxrOptions, ctx: Context) -> PageServer:
    """Open the page for a device. The first device starts it, and prints its address and QR code.

    Raises:
        TeleopError: if it cannot be served, or its options differ from those of another device with this address.
    """
    with _lock:
        shared = _open.get(_key(options, ctx))
        if shared is None:
            assert ctx.bus is not None  # devices run in the host
            server = PageServer(options, ctx.clock, ctx.bus, ctx.log)
            shared = _open[_key(options, ctx)] = _Shared(server, options, ctx.name)
            # Not logged: the address contains the token.
            echo(f"{ctx.name}: open this page on the phone or headset:\n{qr_code(server.address)}", err=True)
            echo(server.address, err=True)
        for name in _SHARED:
            if attrs.asdict(options)[name] != attrs.asdict(shared.options)[name]:
                raise TeleopError(
                    f"{ctx.name}: shares the page on port {options.port} with {shared.device}: give both the same "
                    f"{name}, or different ports"
                )
        shared.users += 1
        return shared.server


def close_page(options: WebxrOptions, ctx: Context) -> None:
    """Close the page for a device; the last device stops it."""
    with _lock:
        shared = _open[_key(options, ctx)]
        shared.users -= 1
        if shared.users:
            return
        del _open[_key(options, ctx)]
    shared.server.close()


def qr_code(text: str) -> str:
    """A QR code as lines of half blocks, for light text on a dark terminal; phones read inverted codes, too."""
    drawn = StringIO()
    segno.make(text, error="l").terminal(drawn, border=2, compact=True)
    return drawn.getvalue().rstrip("\n")

"""Ports for servers that a test starts."""

from __future__ import annotations

import atexit
import itertools
import socket


def _reserve() -> socket.socket:
    """Bind a port without listening on it."""
    reserved = socket.socket()
    reserved.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    reserved.bind(("127.0.0.1", 0))
    atexit.register(reserved.close)
    return reserved


# Here, so that no test opens them; far more than one test uses.
_reserved = itertools.cycle([_reserve() for _ in range(32)])


def free_port() -> int:
    """Return a TCP port of 127.0.0.1 on which a server can listen, whatever else runs meanwhile.

    The port is bound, so the system gives it to no other process. Nothing listens on it, so clients are refused. A
    server that sets SO_REUSEADDR can listen on it, as those of asyncio, Zenoh and Python do.
    """
    port: int = next(_reserved).getsockname()[1]
    return port

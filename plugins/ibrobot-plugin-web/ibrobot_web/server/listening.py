"""Where a server listens: its socket, its certificate, and the host names under which browsers reach it."""

from __future__ import annotations

import logging
import socket
import ssl
from collections.abc import Sequence

from aiohttp import web

from ibrobot_core.api import IbrobotError
from ibrobot_web.options import is_loopback

REQUEST_S = 5.0
"""Time in which a client must send a request [s]."""
_LINGER_S = 1.0
"""Time for which the rest of a request is still read after its answer [s]."""


def runner_of(app: web.Application, close_s: float) -> web.AppRunner:
    """What runs an application; at its end, requests are given `close_s` [s].

    It closes connections on which no request arrives within `REQUEST_S`. Clients that send what is no HTTP are no news:
    the server's own messages stay out of the log.
    """
    quiet = logging.getLogger("ibrobot.web.http")
    quiet.setLevel(logging.CRITICAL)
    return web.AppRunner(
        app,
        access_log=None,
        logger=quiet,
        keepalive_timeout=REQUEST_S,
        lingering_time=_LINGER_S,
        shutdown_timeout=close_s,
    )


def tls_of(prefix: str, certificate: str | None, key: str | None) -> ssl.SSLContext | None:
    """The TLS context of a certificate and its key; None without a certificate.

    Args:
        prefix: of the error, e.g. `viewer: `.
        certificate: path of the certificate, with the chain of its authority.
        key: path of its private key.

    Raises:
        IbrobotError: if they cannot be used.
    """
    if certificate is None:
        return None
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    try:
        context.load_cert_chain(certificate, key)
    except (OSError, ssl.SSLError) as error:
        raise IbrobotError(f"{prefix}certificate {certificate} and its key cannot be used: {error}") from None
    return context


def host_names(host: str, given: Sequence[str]) -> tuple[str, ...]:
    """Host names under which browsers reach a server at `host`, and those `given`."""
    if is_loopback(host):
        return ("127.0.0.1", "localhost", "[::1]", *given)
    own = socket.gethostname()
    names = (own, f"{own}.local", *given)
    return names if host in ("0.0.0.0", "::") else (f"[{host}]" if ":" in host else host, *names)


def listen(prefix: str, host: str, port: int, any_port: str) -> socket.socket:
    """A listening socket.

    Args:
        prefix: of the error, e.g. `viewer: `.
        host: the address.
        port: the port; 0 for any free one.
        any_port: the option that chooses any free port.

    Raises:
        IbrobotError: if the port is not available.
    """
    try:
        return socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET)
    except OSError as error:
        raise IbrobotError(
            f"{prefix}port {port} of {host} is not available: {error.strerror}; choose another, or any free one: "
            f"{any_port}"
        ) from None

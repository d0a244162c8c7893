"""Address of a server: its socket, its certificate, and the names under which browsers reach it."""

from __future__ import annotations

import socket
import ssl
import stat
from collections.abc import Sequence
from pathlib import Path

import attrs

from ibrobot_core.api import IbrobotError


@attrs.frozen(eq=False)
class Listener:
    """An open port; clients wait until a server uses it."""

    socket: socket.socket
    names: tuple[str, ...]
    """Names and addresses under which clients may reach the server; the first is that of `url`."""
    tls: ssl.SSLContext | None = None
    """The certificate; None for a server without TLS."""
    port: int = attrs.field(init=False)

    @port.default
    def _port(self) -> int:
        return int(self.socket.getsockname()[1])

    @property
    def scheme(self) -> str:
        """`https` or `http`."""
        return "http" if self.tls is None else "https"

    @property
    def url(self) -> str:
        """The address of the server, without a path."""
        return f"{self.scheme}://{bracketed(self.names[0])}:{self.port}"


def bracketed(name: str) -> str:
    """Format a name or address for a URL, with brackets around IPv6."""
    return f"[{name}]" if ":" in name else name


def listen(
    host: str, port: int, names: Sequence[str], *, tls: ssl.SSLContext | None = None, of: str = "", any_port: str = "0"
) -> Listener:
    """Open a port.

    Args:
        host: the address.
        port: the port; 0 for any free one.
        names: names and addresses under which clients may reach the server.
        tls: the certificate.
        of: begins the error: the part of the robot YAML, e.g. `viewer:`, and a space.
        any_port: the option that chooses any free port, for the error.

    Raises:
        IbrobotError: if the port is not available.
    """
    try:
        opened = socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET)
    except OSError as error:
        raise IbrobotError(
            f"{of}port {port} of {host} is not available: {error.strerror}; choose another, or any free one: {any_port}"
        ) from None
    return Listener(opened, tuple(names), tls)


def tls_context(certificate: Path, key: Path, *, of: str = "") -> ssl.SSLContext:
    """The TLS settings of a server with a certificate and its key.

    Args:
        certificate: the certificate, with the chain of its authority.
        key: its private key, which other users of the machine must not be able to use.
        of: begins the error: the part of the robot YAML, e.g. `viewer:`, and a space.

    Raises:
        IbrobotError: if they cannot be used.
    """
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    try:
        exposed = key.stat().st_mode & stat.S_IRWXO
        context.load_cert_chain(certificate, key, password=lambda: "")  # instead of a question in the terminal
    except (OSError, ValueError) as error:
        raise IbrobotError(f"{of}certificate {certificate} and key {key} cannot be used: {error}") from None
    if exposed:
        raise IbrobotError(f"{of}every user of this machine may use the key {key}: chmod 600 {key}")
    return context

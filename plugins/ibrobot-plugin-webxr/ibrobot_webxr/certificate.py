"""The page's port and certificate, the configured one or the self-signed one of this installation, and its checks."""

from __future__ import annotations

import os
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

from ibrobot_http.addresses import LOCAL, host_names, is_loopback, network_address
from ibrobot_http.certificates import CERTIFICATE, KEY, expiry, own_certificate
from ibrobot_http.listener import Listener, listen, tls_context

from ibrobot_core.api import Check, IbrobotError, TeleopError
from ibrobot_webxr.options import WebxrOptions


def own_folder() -> Path:
    """The folder of the self-signed certificate: `$XDG_CONFIG_HOME/ibrobot/webxr`, by default in `~/.config`."""
    home = Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config")
    return home / "ibrobot" / "webxr"


def server_names(options: WebxrOptions) -> tuple[str, ...]:
    """Names and addresses under which browsers may reach the page; the first is that of the printed address."""
    if options.names or is_loopback(options.host):
        return tuple(dict.fromkeys((*options.names, "localhost", *LOCAL)))
    address = network_address() if options.host in ("0.0.0.0", "::") else None
    return tuple(dict.fromkeys((*((address,) if address else ()), *host_names(options.host))))


def open_port(options: WebxrOptions) -> Listener:
    """Open the port of the page.

    Raises:
        TeleopError: if the port is not available, or the certificate or key cannot be read or written.
    """
    names = server_names(options)
    try:
        if options.certificate is not None and options.key is not None:
            certificate, key = options.certificate, options.key
        else:
            certificate, key = own_certificate(own_folder(), names)
        return listen(options.host, options.port, names, tls=tls_context(certificate, key))
    except IbrobotError as error:
        raise TeleopError(str(error)) from None
    except OSError as error:
        raise TeleopError(f"{error.filename}: {error.strerror}") from error


def checks(folder: Path | None = None) -> Iterator[Check]:
    """Check the page's own certificate and the permissions of its key, if the page has been served before."""
    folder = own_folder() if folder is None else folder
    certificate, key = folder / CERTIFICATE, folder / KEY
    remedy = f"remove {folder}: the next launch makes a new certificate, which browsers ask to accept again"
    if not certificate.exists():
        yield Check("webxr certificate", True, "none yet; the first launch with a page makes one")
        return
    try:
        end = expiry(certificate)
        mode = key.stat().st_mode & 0o777
    except (OSError, ValueError) as error:
        yield Check("webxr certificate", False, f"{certificate} or its key cannot be read: {error}", remedy)
        return
    yield Check("webxr certificate", end > datetime.now(UTC), f"{certificate}, valid until {end:%Y-%m-%d}", remedy)
    yield Check("webxr key", not mode & 0o077, f"{key}, mode {mode:04o}", f"chmod 600 {key}")

"""Checks for `ibrobot doctor`."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

from ibrobot_http.certificates import CERTIFICATE, KEY, expiry

from ibrobot_core.api import Check
from ibrobot_webxr.certificate import own_folder


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

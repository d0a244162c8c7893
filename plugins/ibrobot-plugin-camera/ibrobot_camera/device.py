"""Resolves `device` of a YAML: a V4L2 device, a network stream, or a video file."""

from __future__ import annotations

import re
from pathlib import Path
from urllib.parse import urlsplit

import attrs

from ibrobot_core.api import SensorError

BY_ID = Path("/dev/v4l/by-id")
BY_PATH = Path("/dev/v4l/by-path")
LIST = "`ibrobot camera list` shows the available ones"
NO_DEVICE = "there is no such device"
_URL = re.compile(r"[a-z][a-z0-9+.-]*://", re.IGNORECASE)


@attrs.frozen
class Device:
    """An image source."""

    kind: str
    """`v4l2`, `stream` or `file`."""
    target: str
    """A device's path, a URL, or a file's path."""

    def __str__(self) -> str:
        """Text for messages, without user, password and query, since some cameras take passwords in the query."""
        if self.kind != "stream":
            return self.target
        parts = urlsplit(self.target)
        host = parts.netloc.rpartition("@")[2]
        return parts._replace(netloc=host, query="…" if parts.query else "").geturl()


def find_device(device: int | str) -> Device:
    """Find the device that `device` refers to.

    Raises:
        SensorError: if it does not exist.
    """
    text = str(device)
    if _URL.match(text):
        return Device("stream", text)
    if text.isdigit():
        return Device("v4l2", f"/dev/video{text}")
    for folder in (BY_ID, BY_PATH):
        if "/" not in text and (folder / text).exists():
            return Device("v4l2", str(folder / text))
    path = Path(text).expanduser()
    if text.startswith("/dev/"):
        return Device("v4l2", text)
    if path.is_file():
        return Device("file", str(path))
    raise SensorError(f"no file, URL or device {text!r}; {_stable()}")


def _stable() -> str:
    """The names of the cameras that are there, which stay the same, for messages."""
    known = []
    for folder in (BY_ID, BY_PATH):
        there = ", ".join(sorted(entry.name for entry in folder.iterdir())) if folder.is_dir() else "none"
        known.append(f"devices under {folder}: {there}")
    return "; ".join(known)

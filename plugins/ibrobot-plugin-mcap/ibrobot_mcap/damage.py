"""What is raised when outside data cannot be read."""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import zstandard
from mcap.exceptions import McapError

from ibrobot_core.api import RecorderError

_PARSING = (
    struct.error, ValueError, LookupError, TypeError, AttributeError, EOFError, OverflowError, RecursionError,
    MemoryError, RuntimeError, McapError, zstandard.ZstdError, sqlite3.Error,
)  # fmt: skip
"""What parsers raise for bytes that are not what they expect; lz4 raises RuntimeError."""


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Whatever a parser raises within becomes a `RecorderError` that names the file."""
    try:
        yield
    except OSError as error:
        raise RecorderError(f"{path}: cannot be read: {error.strerror or error}") from error
    except _PARSING as error:
        what = f"{error}".strip() or "no more is known"
        raise RecorderError(f"{path}: is damaged: {what} ({type(error).__name__})") from error

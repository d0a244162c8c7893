"""Errors for unreadable data."""

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
"""Exceptions that parsers raise for invalid bytes; lz4 raises RuntimeError."""


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """A context that turns errors of parsers into a `RecorderError` that names the file."""
    try:
        yield
    except OSError as error:
        raise RecorderError(f"{path}: cannot be read: {error.strerror or error}") from error
    except _PARSING as error:
        what = f"{error}".strip() or "unknown error"
        raise RecorderError(f"{path}: is damaged: {what} ({type(error).__name__})") from error

"""Atomic replacement of files."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO


def replace_file(path: Path, content: bytes | Callable[[BinaryIO], None]) -> None:
    """Write `path` atomically: a crash leaves either the old or the new content.

    Args:
        path: the file.
        content: the bytes, or a function that writes them to the open file.

    Raises:
        OSError: e.g. if the disk is full; the old content remains.
    """
    partial = path.with_name(f".{path.name}.partial")
    try:
        with partial.open("wb") as file:
            if callable(content):
                content(file)
            else:
                file.write(content)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise

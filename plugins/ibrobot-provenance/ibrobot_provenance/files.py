"""Files that survive a crash."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO
from uuid import uuid4


def replace_file(path: Path, content: bytes | str | Callable[[BinaryIO], object]) -> None:
    """Write a file atomically, and flush it to the disk: after a crash it has either the old or the new content.

    Args:
        path: the file.
        content: bytes, text to encode as UTF-8, or a function that writes to the open file.

    Raises:
        OSError: e.g. if the disk is full; the old content remains.
    """
    partial = path.with_name(f".{path.name}.{uuid4().hex}")
    try:
        with partial.open("wb") as file:
            if callable(content):
                content(file)
            else:
                file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise
    sync(path.parent)


def sync(path: Path) -> None:
    """Flush a file, or the entries of a folder, to the disk.

    Raises:
        OSError: if it cannot be read.
    """
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)

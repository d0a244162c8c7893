"""Memory that processes share: an unnamed file, passed by descriptor, which leaves nothing behind."""

from __future__ import annotations

import os
import tempfile


def create_memory() -> int:
    """The descriptor of an empty unnamed file."""
    if hasattr(os, "memfd_create"):
        return os.memfd_create("ibrobot")
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())

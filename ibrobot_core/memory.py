"""Memory shared between processes, as an unnamed file, and settings of glibc's malloc."""

from __future__ import annotations

import ctypes
import os
import tempfile

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
"""Parameters of `mallopt`, from glibc's malloc.h."""


def create_memory() -> int:
    """The descriptor of an empty unnamed file."""
    if hasattr(os, "memfd_create"):
        return os.memfd_create("ibrobot")
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())


def set_malloc(map_from: int, keep: int) -> None:
    """Set which freed memory glibc returns to the system; does nothing with other C libraries.

    By default, glibc adapts its thresholds, so that memory usage depends on the order in which threads free memory.

    Args:
        map_from: size from which allocations are mapped separately and returned at once [bytes]; 32 MiB at most.
        keep: free memory that may stay at the end of the heap [bytes].

    A `MALLOC_MMAP_THRESHOLD_` set by the operator takes precedence.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None and "MALLOC_MMAP_THRESHOLD_" not in os.environ:
        mallopt(_MMAP_THRESHOLD, map_from)
        mallopt(_TRIM_THRESHOLD, keep)

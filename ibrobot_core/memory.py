"""Memory that processes share, as an unnamed file that leaves nothing behind; and how glibc keeps what was freed."""

from __future__ import annotations

import ctypes
import os
import tempfile

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
"""Of `mallopt`, from glibc's malloc.h."""


def create_memory() -> int:
    """The descriptor of an empty unnamed file."""
    if hasattr(os, "memfd_create"):
        return os.memfd_create("ibrobot")
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())


def set_malloc(map_from: int, keep: int) -> None:
    """Say which memory glibc gives back when it is freed; does nothing with another C library.

    By itself it learns from what was freed, so that memory depends on the order in which threads free.

    Args:
        map_from: what is at least as large is mapped on its own, and given back at once [bytes]; 32 MiB at most.
        keep: how much of the smaller may stay free at the end of the heap [bytes].

    An operator's own `MALLOC_MMAP_THRESHOLD_` stands.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None and "MALLOC_MMAP_THRESHOLD_" not in os.environ:
        mallopt(_MMAP_THRESHOLD, map_from)
        mallopt(_TRIM_THRESHOLD, keep)

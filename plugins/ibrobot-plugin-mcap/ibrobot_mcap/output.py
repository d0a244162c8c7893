"""Writes a file, bypassing the page cache if the file system supports it."""

from __future__ import annotations

import errno
import mmap
import os
import threading
from pathlib import Path

_BLOCK = 4096
"""Alignment of writes that bypass the page cache [bytes]."""
_PIECE = 1024 * 1024
"""Maximum size of a write [bytes]."""
# Not every system can sync without the file's times.
_sync = getattr(os, "fdatasync", os.fsync)


class Output:
    """A file whose content survives the end of the process after `hand_over`.

    Whole blocks go directly to the disk: writing gigabytes back from the page cache delays even real-time processes (a
    control loop was 2 ms late in one of a hundred ticks). The end of the file, less than a block, goes through the page
    cache, as does everything if direct writes are not supported.
    """

    def __init__(self, path: Path) -> None:
        self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644)
        self._direct = _open_direct(path)
        self._buffer = memoryview(mmap.mmap(-1, _PIECE))  # page-aligned, as direct writes require
        self._written = 0
        """Number of bytes written to the disk."""
        self._filled = 0
        """Number of bytes in the buffer, which come next."""
        self._closed = False
        self._aside: threading.Thread | None = None
        self._failure: OSError | None = None

    @property
    def size(self) -> int:
        """Size of the file, including the buffer [bytes]."""
        return self._written + self._filled

    def write(self, data: bytes) -> int:
        """Append bytes."""
        rest = memoryview(data)
        while rest:
            taken = min(len(rest), _PIECE - self._filled)
            self._buffer[self._filled : self._filled + taken] = rest[:taken]
            self._filled += taken
            rest = rest[taken:]
            if self._filled == _PIECE:
                self._write_blocks()
        return len(data)

    def tell(self) -> int:
        """Like `size`."""
        return self.size

    def flush(self) -> None:
        """Do nothing; `hand_over` flushes complete records."""

    def hand_over(self) -> None:
        """Pass all data to the operating system."""
        self._write_blocks()
        _write_all(self._descriptor, self._buffer[: self._filled], self._written)

    def _write_blocks(self) -> None:
        size = self._filled - self._filled % _BLOCK
        if size == 0:
            return
        if not self._written_directly(size):
            _write_all(self._descriptor, self._buffer[:size], self._written)
            if hasattr(os, "posix_fadvise"):  # start writing to the disk now, not gigabytes later
                os.posix_fadvise(self._descriptor, self._written, size, os.POSIX_FADV_DONTNEED)
        left = self._filled - size
        self._buffer[:left] = self._buffer[size : self._filled]
        self._written += size
        self._filled = left

    def _written_directly(self, size: int) -> bool:
        if self._direct is None:
            return False
        try:
            _write_all(self._direct, self._buffer[:size], self._written)
        except OSError as error:
            if error.errno != errno.EINVAL:
                raise
            self._close_direct()  # the file system needs another alignment
            return False
        return True

    def sync(self) -> None:
        """Sync the file to the disk.

        Raises:
            OSError: if this or an earlier background sync fails.
        """
        self._wait_aside()
        _sync(self._descriptor)

    def sync_aside(self) -> None:
        """Start a sync in a background thread, because it can take seconds on a busy disk.

        Raises:
            OSError: if an earlier one failed.
        """
        if self._aside is not None and self._aside.is_alive():
            return
        self._wait_aside()
        self._aside = threading.Thread(target=self._sync_or_fail, args=(os.dup(self._descriptor),), daemon=True)
        self._aside.start()

    def _sync_or_fail(self, descriptor: int) -> None:
        try:
            _sync(descriptor)
        except OSError as error:
            self._failure = error
        finally:
            os.close(descriptor)

    def _wait_aside(self) -> None:
        if self._aside is not None:
            self._aside.join()
            self._aside = None
        if self._failure is not None:
            raise self._failure

    def cut(self, size: int) -> None:
        """Truncate the file to `size` bytes, all of which were handed over."""
        os.ftruncate(self._descriptor, size)
        self._close_direct()  # the end is no longer aligned
        self._written, self._filled = size, 0

    def close(self) -> None:
        """Close the file; data that was not handed over is lost. Safe to call twice."""
        if self._aside is not None:
            self._aside.join()
        if not self._closed:
            self._closed = True
            self._close_direct()
            os.close(self._descriptor)

    def _close_direct(self) -> None:
        if self._direct is not None:
            os.close(self._direct)
            self._direct = None


def _open_direct(path: Path) -> int | None:
    """Open the file for direct writes; None if unsupported (macOS, some network file systems)."""
    try:
        return os.open(path, os.O_WRONLY | os.O_DIRECT)
    except (AttributeError, OSError):
        return None


def _write_all(descriptor: int, data: memoryview, offset: int) -> None:
    while data:
        written = os.pwrite(descriptor, data, offset)
        data, offset = data[written:], offset + written

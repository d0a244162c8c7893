"""A file as it is written: beside the page cache where the file system can."""

from __future__ import annotations

import errno
import mmap
import os
import threading
from pathlib import Path

_BLOCK = 4096
"""What a write beside the page cache begins and ends at a multiple of [bytes]."""
_PIECE = 1024 * 1024
"""The most that is written at a time [bytes]."""
# Not everywhere is there a sync that leaves the file's times alone.
_sync = getattr(os, "fdatasync", os.fsync)


class Output:
    """A file whose content is with the operating system after `hand_over`, and survives the process from then on.

    Whole blocks go to the disk at once. Of what the kernel gathers in its page cache it writes gigabytes at a time,
    and even processes of real-time priority wait meanwhile: a control loop was 2 ms late in one of a hundred ticks.
    The end of the file, less than a block, goes through the page cache, as all does where there is no way beside it.
    """

    def __init__(self, path: Path) -> None:
        self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644)
        self._direct = _open_direct(path)
        self._buffer = memoryview(mmap.mmap(-1, _PIECE))  # begins at a page, as such writes must
        self._written = 0
        """Up to here all is with the disk [bytes]."""
        self._filled = 0
        """Of the buffer, which has what follows [bytes]."""
        self._closed = False
        self._aside: threading.Thread | None = None
        self._failure: OSError | None = None

    @property
    def size(self) -> int:
        """Bytes in the file, buffered ones included."""
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
        """As `size`."""
        return self.size

    def flush(self) -> None:
        """Nothing: `hand_over` does it, when the records are whole."""

    def hand_over(self) -> None:
        """Give everything to the operating system."""
        self._write_blocks()
        _write_all(self._descriptor, self._buffer[: self._filled], self._written)

    def _write_blocks(self) -> None:
        size = self._filled - self._filled % _BLOCK
        if size == 0:
            return
        if not self._written_directly(size):
            _write_all(self._descriptor, self._buffer[:size], self._written)
            if hasattr(os, "posix_fadvise"):  # begins to write it to the disk, now and not gigabytes later
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
            self._close_direct()  # a file system that takes such writes only at its own boundaries
            return False
        return True

    def sync(self) -> None:
        """Put what is in the file onto the disk.

        Raises:
            OSError: when the disk refuses it now, or refused it aside.
        """
        self._wait_aside()
        _sync(self._descriptor)

    def sync_aside(self) -> None:
        """Begin a sync in a thread: a busy disk takes seconds for it, in which messages must be written.

        Raises:
            OSError: when an earlier one failed.
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
        """Leave the first `size` bytes, of which all were handed over."""
        os.ftruncate(self._descriptor, size)
        self._close_direct()  # what follows does not begin at a block
        self._written, self._filled = size, 0

    def close(self) -> None:
        """Close as it is; what was not handed over is lost. Safe to call twice."""
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
    """The file for writes beside the page cache; None where there are none (macOS, some network file systems)."""
    try:
        return os.open(path, os.O_WRONLY | os.O_DIRECT)
    except (AttributeError, OSError):
        return None


def _write_all(descriptor: int, data: memoryview, offset: int) -> None:
    while data:
        written = os.pwrite(descriptor, data, offset)
        data, offset = data[written:], offset + written

"""Standard output and error that never block: a thread writes them, and a pipe or terminal that is full loses lines."""

from __future__ import annotations

import io
import os
import select
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout, suppress
from typing import TextIO, override

_MOST = 1 << 18
"""Largest number of bytes that wait for a reader."""


class AsideStream(io.TextIOBase):
    """A text stream whose writers never wait: a thread of its own writes to `stream`.

    What does not fit into the queue is dropped, counted, and mentioned once the reader reads again.

    Args:
        stream: e.g. `sys.stdout`; it must have a file descriptor.
        most: largest number of bytes that wait.
    """

    def __init__(self, stream: TextIO, most: int = _MOST) -> None:
        stream.flush()
        self._stream = stream
        self._fd = stream.fileno()
        self._most = most
        self._waiting: deque[bytes] = deque()
        self._size = 0
        self._changed = threading.Condition()
        self._ending = False
        self._error: OSError | None = None
        self.dropped = 0
        """Number of writes dropped since the last mention."""
        self._thread = threading.Thread(target=self._write_all, name=f"output {self._fd}", daemon=True)
        self._thread.start()

    @property
    @override
    def encoding(self) -> str:  # type: ignore[override]
        return self._stream.encoding

    @property
    @override
    def errors(self) -> str | None:  # type: ignore[override]
        return self._stream.errors

    @override
    def fileno(self) -> int:
        return self._fd

    @override
    def isatty(self) -> bool:
        return self._stream.isatty()

    @override
    def writable(self) -> bool:
        return True

    @override
    def write(self, text: str, /) -> int:
        """Queue a text.

        Raises:
            OSError: if an earlier text could not be written, e.g. because the reader is gone.
        """
        encoded = text.encode(self.encoding, self.errors or "strict")
        with self._changed:
            if self._error is not None:
                raise self._error
            if self._size + len(encoded) > self._most:
                self.dropped += 1
            else:
                self._mention_dropped()
                self._put(encoded)
        return len(text)

    def end(self, timeout_s: float | None) -> bool:
        """Write what waits, for at most `timeout_s` [s], without limit if None; return whether all was written."""
        with self._changed:
            self._mention_dropped()
            self._ending = True
            self._changed.notify()
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _put(self, encoded: bytes) -> None:
        self._waiting.append(encoded)
        self._size += len(encoded)
        self._changed.notify()

    def _mention_dropped(self) -> None:
        if self.dropped:
            dropped, self.dropped = self.dropped, 0
            self._put(f"(nothing read this output; messages dropped: {dropped})\n".encode(self.encoding, "replace"))

    def _write_all(self) -> None:
        try:
            while (encoded := self._take()) is not None:
                while encoded:
                    try:
                        encoded = encoded[os.write(self._fd, encoded) :]
                    except BlockingIOError:
                        select.select([], [self._fd], [])
        except OSError as error:  # raised to the next writer
            with self._changed:
                self._error = error
                self._waiting.clear()

    def _take(self) -> bytes | None:
        with self._changed:
            while not (self._waiting or self._ending):
                self._changed.wait()
            if not self._waiting:
                return None
            encoded = self._waiting.popleft()
            self._size -= len(encoded)
            return encoded


@contextmanager
def output_aside(patience: Callable[[], float | None] = lambda: None) -> Iterator[None]:
    """Have threads write standard output and error, so that a reader that pauses blocks no thread of this process.

    Args:
        patience: returns how long the end waits for a reader [s], without limit if None. What is not read by then,
            and all later output, is lost.
    """
    with ExitStack() as stack:
        for stream, redirect in ((sys.stdout, redirect_stdout), (sys.stderr, redirect_stderr)):
            with suppress(OSError, ValueError, AttributeError):  # no file, e.g. in tests: it never blocks
                aside = AsideStream(stream)
                stack.callback(_end, aside, patience)
                stack.enter_context(redirect(aside))
        yield


def _end(aside: AsideStream, patience: Callable[[], float | None]) -> None:
    if not aside.end(patience()):
        discard([aside.fileno()])


def discard(descriptors: list[int]) -> None:
    """Redirect these descriptors to the null device."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for descriptor in descriptors:
        os.dup2(nowhere, descriptor)
    os.close(nowhere)

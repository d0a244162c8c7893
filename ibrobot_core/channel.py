"""Messages between processes: JSON objects, each with bytes if it needs some, over a stream socket.

A frame has two sizes, a JSON text and bytes. The text is `["message", {…}]`; reports have another word, so that nothing
in a message can pass for one. Both sides drop other frames.

A peer may run in an interpreter that lacks everything but Python 3.10: this module imports the standard library only.
"""

from __future__ import annotations

import json
import os
import select
import socket
import struct
import threading
import time
from collections import deque
from collections.abc import Generator, Iterable, Mapping
from contextlib import suppress
from itertools import islice
from typing import Any

_SIZES = struct.Struct("<II")
_BUFFER = 1 << 16
"""Most bytes read at once, unless a frame lacks more."""
_LONGEST, _LARGEST = 64 << 20, 256 << 20
"""Most bytes of a text, and with it; a peer that announces more is disconnected, as is one that leaves more unread."""


class ChannelMessage(dict[str, Any]):
    """A received object."""

    word: str = "message"
    """What it is: `message`, or a report of a child."""
    payload: memoryview = memoryview(b"")
    """The bytes that came with it."""


class Channel:
    """One end of a connection. A dead peer raises no error; it sets `closed`. Sending is thread-safe.

    `send` never waits for a peer that does not read, so that a stopped host cannot stop the control loop.

    Args:
        connection: a connected stream socket.
    """

    def __init__(self, connection: socket.socket) -> None:
        connection.setblocking(False)
        self._socket = connection
        self._sending = threading.Lock()
        self._unsent: deque[memoryview] = deque()
        self._wake, self._waker = os.pipe()
        os.set_blocking(self._waker, False)
        self._frames = self._read_frames()
        self._room = next(self._frames)
        self._arrived: list[ChannelMessage] = []
        self.closed = False
        """Whether the peer has closed the connection or died; known once all that it sent has been received."""
        self.backlog = 0
        """Number of bytes that the peer has not read yet."""
        self.dropped = 0
        """Number of frames that were neither messages nor reports."""

    def fileno(self) -> int:
        """The socket's descriptor, for `select`."""
        return self._socket.fileno()

    def send(self, message: Mapping[str, Any], *payload: bytes | memoryview, word: str = "message") -> None:
        """Send an object and bytes without blocking; a later call sends what the peer does not read yet.

        The bytes must not change until the peer has read them.
        """
        self._put(_frame(message, payload, word))

    def send_all(self, messages: Iterable[tuple[Mapping[str, Any], bytes]]) -> None:
        """Send objects with their bytes at once: each system call may cost a turn of this process's other threads."""
        self._put([part for message, payload in messages for part in _frame(message, (payload,))])

    def _put(self, parts: list[memoryview]) -> None:
        with self._sending:
            self.closed = self.closed or self.backlog > _LARGEST
            if self.closed:
                return
            self._unsent += parts
            self.backlog += sum(map(len, parts))
            self._flush()
            if self.backlog:
                self.wake()

    def wake(self) -> None:
        """Have `receive` return in another thread."""
        with suppress(BlockingIOError):
            os.write(self._waker, b"x")

    def flush(self, timeout_s: float = 1.0) -> bool:
        """Wait up to `timeout_s` [s] for the peer to read all, and return whether it has."""
        deadline_s = time.monotonic() + timeout_s
        while self.backlog and not self.closed and (left_s := deadline_s - time.monotonic()) > 0:
            select.select([], [self._socket], [], left_s)
            with self._sending:
                self._flush()
        return not (self.backlog or self.closed)

    def _flush(self) -> None:
        while self._unsent and not self.closed:
            try:
                sent = self._socket.sendmsg([*islice(self._unsent, 256)])  # a system call has a limit
            except BlockingIOError:
                return
            except OSError:
                self.closed = True
                return
            self.backlog -= sent
            while sent:
                first = self._unsent.popleft()
                if sent < len(first):
                    self._unsent.appendleft(first[sent:])
                sent -= min(sent, len(first))

    def receive(self, timeout_s: float | None = 0.0) -> list[ChannelMessage]:
        """The messages that have arrived completely; sends what is left to send.

        Args:
            timeout_s: longest wait for bytes to arrive, for `wake`, or for the peer to read [s]; None for no limit.
        """
        if timeout_s != 0.0 and not (self._arrived or self.closed):
            unsent = [self._socket] if self.backlog else []
            ready, _, _ = select.select([self._socket.fileno(), self._wake], unsent, [], timeout_s)
            if self._wake in ready:
                os.read(self._wake, 4096)
        self._exchange()
        arrived, self._arrived = self._arrived, []
        return arrived

    def next(self, timeout_s: float | None = 0.0) -> ChannelMessage | None:
        """The next message; None if none arrives within `timeout_s` [s], or before the end of the peer."""
        deadline_s = time.monotonic() + (timeout_s or 0.0)
        while True:
            left_s = None if timeout_s is None else max(0.0, deadline_s - time.monotonic())
            self._arrived = self.receive(left_s)
            if self._arrived:
                return self._arrived.pop(0)
            if self.closed or left_s == 0.0:
                return None

    def close(self) -> None:
        """Close the connection; safe to call twice. Nothing may wait meanwhile."""
        with self._sending:
            self.closed = True
            if self._socket.fileno() >= 0:
                self._socket.close()
                os.close(self._wake)
                os.close(self._waker)

    def _exchange(self) -> None:
        """Send and read what can be without waiting."""
        if self.backlog:
            with self._sending:
                self._flush()
        drained = False
        while not (self.closed or drained):
            try:
                count = self._socket.recv_into(self._room)
            except BlockingIOError:
                return
            except OSError:
                count = 0
            self.closed = self.closed or not count
            drained = count < len(self._room)
            self._room = self._frames.send(count)

    def _read_frames(self) -> Generator[memoryview, int, None]:
        """Take frame after frame; yields the memory that the next bytes belong in, and is sent their number."""
        buffer = memoryview(bytearray(_BUFFER))
        filled = 0
        while True:
            filled += yield buffer[filled:]
            begin = 0
            while filled - begin >= _SIZES.size and not self.closed:
                size, payload = _SIZES.unpack_from(buffer, begin)
                if not size or size > _LONGEST or payload > _LARGEST:
                    self.closed = True
                    break
                block = memoryview(bytearray(size + payload))
                begin += _SIZES.size
                read = min(len(block), filled - begin)
                block[:read] = buffer[begin : begin + read]
                begin += read
                while read < len(block):
                    read += yield block[read:]
                self._take(block[:size], block[size:])
            buffer[: filled - begin] = buffer[begin:filled]
            filled -= begin

    def _take(self, text: memoryview, payload: memoryview) -> None:
        try:
            word, content = json.loads(bytes(text))
            if not isinstance(word, str) or not isinstance(content, dict):
                raise ValueError("neither a message nor a report")
        except (ValueError, TypeError, RecursionError):
            self.dropped += 1
            return
        message = ChannelMessage(content)
        message.word, message.payload = word, payload
        self._arrived.append(message)


def _frame(message: Mapping[str, Any], payload: Iterable[Any], word: str = "message") -> list[memoryview]:
    text = json.dumps([word, message], separators=(",", ":")).encode()
    views = [memoryview(part).cast("B") for part in payload if len(part)]
    return [memoryview(_SIZES.pack(len(text), sum(map(len, views))) + text), *views]

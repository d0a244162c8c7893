"""Frames between a run and its ROS node, over a local socket: a JSON object and, for messages, their bytes.

The node runs in an interpreter that may lack everything but ROS, so this module imports the standard library only.
"""

from __future__ import annotations

import json
import os
import select
import socket
import struct
import threading
from collections import deque
from collections.abc import Iterable, Mapping
from contextlib import suppress
from itertools import islice
from typing import Any

Frame = tuple[dict[str, Any], bytes]
"""An object, whose key `op` says what it is, and a payload."""
_SIZES = struct.Struct("<II")
_LONGEST = 1 << 28
"""Longest object or payload [bytes]; a peer that announces a longer one is disconnected."""
_CHUNK = 1 << 18
_MOST = 256
"""Parts of frames that one system call sends."""


class Wire:
    """One end of the socket. `send` never blocks; a dead peer raises no error but sets `closed`. Thread-safe."""

    def __init__(self, connection: socket.socket) -> None:
        connection.setblocking(False)
        self._socket = connection
        self._sending = threading.Lock()
        self._unsent: deque[memoryview] = deque()
        self._received = bytearray()
        self._wake, self._waker = os.pipe()
        os.set_blocking(self._waker, False)
        self.closed = False
        """Whether the peer has closed the socket or died."""
        self.backlog = 0
        """Number of bytes that the peer has not read yet."""

    def send(self, head: Mapping[str, Any], payload: bytes = b"") -> None:
        """Send a frame, or queue it until `wait` can send it."""
        self.send_all([(head, payload)])

    def send_all(self, frames: Iterable[tuple[Mapping[str, Any], bytes]]) -> None:
        """Send frames, or queue them, at once: each system call may cost a turn of this process's other threads."""
        parts: list[memoryview] = []
        for head, payload in frames:
            text = json.dumps(head, separators=(",", ":")).encode()
            parts.append(memoryview(_SIZES.pack(len(text), len(payload)) + text))
            if payload:
                parts.append(memoryview(payload))
        with self._sending:
            if self.closed:
                return
            self._unsent += parts
            self.backlog += sum(map(len, parts))
            self._flush()
            if self.backlog:
                self.wake()

    def wake(self) -> None:
        """Have `wait` return."""
        with suppress(BlockingIOError):
            os.write(self._waker, b"x")

    def wait(self, timeout_s: float) -> list[Frame]:
        """The frames that have arrived; waits up to `timeout_s` [s] for one, or for `wake`, and sends meanwhile."""
        if self.closed:
            return []
        sending = [self._socket] if self.backlog else []
        both: list[Any] = [self._socket, self._wake]
        ready, writable, _ = select.select(both, sending, [], timeout_s)
        if self._wake in ready:
            os.read(self._wake, 4096)
        if writable or self.backlog:
            with self._sending:
                self._flush()
        return self._read() if self._socket in ready else []

    def flush(self, timeout_s: float) -> bool:
        """Wait up to `timeout_s` [s] until the peer has read all; returns whether it has. Not beside `wait`."""
        while self.backlog and not self.closed:
            if not select.select([], [self._socket], [], timeout_s)[1]:
                return False
            with self._sending:
                self._flush()
        return not self.closed

    def close(self) -> None:
        """Close the socket; safe to call twice. Nothing may wait meanwhile."""
        with self._sending:
            self.closed = True
            if self._socket.fileno() >= 0:
                self._socket.close()
                os.close(self._wake)
                os.close(self._waker)

    def _flush(self) -> None:
        while self._unsent and not self.closed:
            try:
                sent = self._socket.sendmsg([*islice(self._unsent, _MOST)])
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

    def _read(self) -> list[Frame]:
        while not self.closed:
            try:
                part = self._socket.recv(_CHUNK)
            except BlockingIOError:
                break
            except OSError:
                part = b""
            self._received += part
            if not part:
                self.closed = True
            if len(part) < _CHUNK:
                break
        return self._frames()

    def _frames(self) -> list[Frame]:
        frames: list[Frame] = []
        begin = 0
        while len(self._received) - begin >= _SIZES.size:
            head, body = _SIZES.unpack_from(self._received, begin)
            if max(head, body) > _LONGEST:
                self.closed = True
                break
            middle = begin + _SIZES.size + head
            if len(self._received) < middle + body:
                break
            text = bytes(self._received[begin + _SIZES.size : middle])
            frames.append((json.loads(text), bytes(self._received[middle : middle + body])))
            begin = middle + body
        del self._received[:begin]
        return frames

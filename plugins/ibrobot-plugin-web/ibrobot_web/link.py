"""The link between a run and the process of its page: states and pictures one way, newest only; commands by a channel.

States and pictures go over a stream socket of their own, so that no answer to a command waits behind them. Each frame
belongs to a channel, and the newest frame of a channel replaces one that was not sent yet.
"""

from __future__ import annotations

import asyncio
import socket
import struct
import threading

STATE, STATUS, SAMPLES, PLAN, FIRST_PICTURE = 0, 1, 2, 3, 16
"""Channels of the stream:

| channel | content | encoding |
|---|---|---|
| `STATE` | joint states | JSON |
| `STATUS` | everything else about the run | JSON |
| `SAMPLES` | topics to plot | JSON |
| `PLAN` | the plan | JSON |
| `FIRST_PICTURE` and up | pictures, a channel per camera | binary, see `PICTURE_HEAD` |
"""
PICTURE_HEAD = struct.Struct("<qHHB")
"""Before a picture's bytes: stamp [ns], width and height [px], encoding."""
JPEG, RGB, PNG = 0, 1, 2
"""Encodings of pictures."""
ALIVE_S = 0.5
"""Period of the server's signs of life [s]."""
_HEAD = struct.Struct("<IB")
_LARGEST = 256 << 20
"""Largest frame [bytes]."""


class FrameSender:
    """The run's end. Sending never waits: what the other side does not read yet is kept, newest only. Thread-safe.

    Args:
        connection: a connected stream socket.
    """

    def __init__(self, connection: socket.socket) -> None:
        connection.setblocking(False)
        self._socket = connection
        self._waiting: dict[int, bytes] = {}
        self._partial = memoryview(b"")
        self._lock = threading.Lock()
        self.replaced = 0
        """Number of frames that a newer one replaced."""

    def send(self, channel: int, payload: bytes) -> None:
        """Send a frame, or keep it until `flush` if the other side is behind."""
        with self._lock:
            self.replaced += channel in self._waiting
            self._waiting[channel] = payload
            self._flush()

    def flush(self) -> None:
        """Send what was kept, as far as the other side reads."""
        with self._lock:
            self._flush()

    def _flush(self) -> None:
        try:
            while self._partial or self._waiting:
                if not self._partial:
                    channel = next(iter(self._waiting))
                    payload = self._waiting.pop(channel)
                    self._partial = memoryview(_HEAD.pack(len(payload), channel) + payload)
                self._partial = self._partial[self._socket.send(self._partial) :]
        except BlockingIOError:
            return
        except OSError:  # the other side is gone, which its channel reports
            self._waiting.clear()
            self._partial = memoryview(b"")

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


async def receive_frame(reader: asyncio.StreamReader) -> tuple[int, bytes]:
    """The next frame: channel and payload.

    Raises:
        asyncio.IncompleteReadError: at the end of the stream.
    """
    size, channel = _HEAD.unpack(await reader.readexactly(_HEAD.size))
    if size > _LARGEST:
        raise ValueError(f"a frame of {size} bytes is larger than {_LARGEST}")
    return channel, await reader.readexactly(size)

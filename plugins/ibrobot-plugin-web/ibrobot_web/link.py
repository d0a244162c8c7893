"""The link between a run and the process of its page: states and pictures one way, newest only; commands by a channel.

States and pictures go over a stream socket of their own, so that no answer to a command waits behind them. Each frame
belongs to a channel, and the newest frame of a channel replaces one that was not sent yet.
"""

from __future__ import annotations

import socket
import struct
import threading

from ibrobot_core.app import Channel

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


class FrameSender:
    """The run's end. Sending never waits: what the other side does not read yet is kept, newest only. Thread-safe.

    Args:
        connection: a connected stream socket.
    """

    def __init__(self, connection: socket.socket) -> None:
        self._channel = Channel(connection)
        self._waiting: dict[int, bytes] = {}
        self._lock = threading.Lock()
        self.replaced = 0
        """Number of frames that a newer one replaced."""

    def send(self, channel: int, payload: bytes) -> None:
        """Send a frame, or keep it until `flush` if the other side is behind."""
        with self._lock:
            self.replaced += channel in self._waiting
            self._waiting[channel] = payload
        self.flush()

    def flush(self) -> None:
        """Send what was kept, as far as the other side reads."""
        with self._lock:
            self._channel.receive()  # sends what is left of the last one
            while self._waiting and not self._channel.backlog:
                channel = next(iter(self._waiting))
                self._channel.send({"channel": channel}, self._waiting.pop(channel))

    def close(self) -> None:
        """Close the socket."""
        self._channel.close()

"""Child processes: start them, exchange messages, end them within a time limit, and report why they died.

A child runs `python -m MODULE CHANNEL DESCRIPTOR…` and inherits the descriptors. The first message on the channel is
its order. The child sends its log records on the channel, and an event `failed` with the `error` if it fails.
"""

from __future__ import annotations

import json
import logging
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from typing import Any, override

from ibrobot_core.errors import ComponentFailed

FAREWELL_S = 1.0
"""Time for which a child's last messages wait for a parent that does not read [s]."""


class Channel:
    """Sends JSON objects as lines over a stream socket. A dead peer raises no error; it sets `closed`.

    `send` never waits for a peer that does not read, so that a stopped host cannot stop the control loop.
    """

    def __init__(self, connection: socket.socket) -> None:
        connection.setblocking(False)
        self._socket = connection
        self._partial = bytearray()
        self._unsent = bytearray()
        self._sending = threading.Lock()
        self.closed = False
        """Whether the peer has closed the connection or died."""

    def fileno(self) -> int:
        """The socket's descriptor, for `select`."""
        return self._socket.fileno()

    def send(self, message: Mapping[str, Any]) -> None:
        """Send an object without blocking; a later call sends what the peer does not read yet."""
        line = json.dumps(message, separators=(",", ":")).encode() + b"\n"
        with self._sending:
            self._unsent += line
            self._flush()

    def flush(self, timeout_s: float = FAREWELL_S) -> None:
        """Wait up to `timeout_s` [s] for the peer to read the unsent data."""
        deadline = time.monotonic() + timeout_s
        while self.backlog and not self.closed and (left := deadline - time.monotonic()) > 0:
            select.select([], [self._socket], [], left)
            with self._sending:
                self._flush()

    @property
    def backlog(self) -> int:
        """Number of unsent bytes."""
        return len(self._unsent)

    def _flush(self) -> None:
        while self._unsent and not self.closed:
            try:
                del self._unsent[: self._socket.send(self._unsent)]
            except BlockingIOError:
                return
            except OSError:
                self.closed = True

    def receive(self) -> list[dict[str, Any]]:
        """The objects that have arrived completely."""
        if self._unsent:
            with self._sending:
                self._flush()
        while not self.closed:
            try:
                received = self._socket.recv(65536)
            except BlockingIOError:
                break
            except OSError:
                received = b""
            if not received:
                self.closed = True
            self._partial += received
        if b"\n" not in self._partial:
            return []
        *lines, rest = bytes(self._partial).split(b"\n")
        self._partial = bytearray(rest)
        return [json.loads(line) for line in lines]

    def wait(self, timeout_s: float | None) -> list[dict[str, Any]]:
        """Wait up to `timeout_s` [s], or without limit if None, for at least one object.

        Raises:
            ComponentFailed: if the peer has closed the connection or died.
        """
        while True:
            messages = self.receive()
            if messages:
                return messages
            if self.closed:
                raise ComponentFailed("the process at the other end is gone")
            unsent = [self._socket] if self._unsent else []
            if not any(select.select([self._socket], unsent, [], timeout_s)):
                return []

    def close(self) -> None:
        """Close the connection."""
        self.closed = True
        self._socket.close()


class Child:
    """The parent's side of a child process and its channel.

    Args:
        module: the module that the child runs.
        order: the first message, completed by `host`, the parent's process id.
        descriptors: further descriptors for the child; they stay open in the parent.

    Attributes:
        channel: the channel to the child.
        failed: the child's event `failed`; None if it has not sent one.
    """

    def __init__(self, module: str, order: Mapping[str, Any], *descriptors: int) -> None:
        own_end, child_end = socket.socketpair()
        with child_end:
            inherited = (child_end.fileno(), *descriptors)
            # A new session: Ctrl-C in the terminal reaches the host alone, which then ends the child in an orderly way.
            self._process = subprocess.Popen(
                [sys.executable, "-m", module, *map(str, inherited)],
                pass_fds=inherited,
                stdin=subprocess.DEVNULL,
                start_new_session=True,
            )
        self.channel = Channel(own_end)
        self.failed: Mapping[str, Any] | None = None
        self._waiting: list[Mapping[str, Any]] = []
        self.channel.send({**order, "host": os.getpid()})

    @property
    def pid(self) -> int:
        """The process id of the child."""
        return self._process.pid

    def receive(self) -> list[Mapping[str, Any]]:
        """The messages that have arrived, except log records and failures, which are handled here."""
        messages, self._waiting = self._waiting, []
        return messages + self._sifted(self.channel.receive())

    def wait(self, timeout_s: float) -> Mapping[str, Any] | None:
        """The next message as in `receive`, or None if none arrives within `timeout_s` [s].

        Raises:
            ComponentFailed: if the child has died.
        """
        if not self._waiting:
            self._waiting = self._sifted(self.channel.wait(timeout_s))
        return self._waiting.pop(0) if self._waiting else None

    def kill(self) -> None:
        """Kill the child."""
        self._process.kill()

    def end(self, timeout_s: float) -> bool:
        """Wait up to `timeout_s` [s] for the child to end, then kill it; return whether it was killed."""
        try:
            self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
            return True
        return False

    def cause(self, timeout_s: float) -> str:
        """End the child as `end` does, and return why it ended: its own error if it sent one, else its exit status."""
        self.end(timeout_s)
        if self.failed is not None:
            return str(self.failed["error"])
        status = self._process.returncode
        return f"killed by {signal.Signals(-status).name}" if status < 0 else f"exit status {status}"

    def _sifted(self, messages: list[dict[str, Any]]) -> list[Mapping[str, Any]]:
        others: list[Mapping[str, Any]] = []
        for message in messages:
            match message.get("event"):
                case "log":
                    logging.getLogger(message["logger"]).log(message["level"], "%s", message["message"])
                case "failed":
                    self.failed = message
                case _:
                    others.append(message)
        return others


class _ToParent(logging.Handler):
    """Sends log records to the parent, which owns the terminal; drops them if the parent does not read."""

    def __init__(self, channel: Channel) -> None:
        super().__init__()
        self._channel = channel

    @override
    def emit(self, record: logging.LogRecord) -> None:
        if not self._channel.backlog:
            event = {"event": "log", "logger": record.name, "level": record.levelno, "message": record.getMessage()}
            self._channel.send(event)


def open_parent(descriptor: int) -> Channel:
    """The child's side: open the channel to the parent, send log records there, and leave Ctrl-C to the parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    channel = Channel(socket.socket(fileno=descriptor))
    root = logging.getLogger("ibrobot")
    root.setLevel(logging.INFO)
    root.propagate = False
    root.addHandler(_ToParent(channel))
    return channel

"""Child processes: a channel to each, shared memory beside it, an end within a time, and the cause of a death.

A child runs `python -m MODULE CHANNEL DESCRIPTOR…`, with descriptors that it inherits. The first message on the channel
is its order. Its log records come back on the channel, and, where it fails, an event `failed` with the `error`.
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
"""How long a child's last messages wait for a parent that does not read."""


class Channel:
    """JSON objects, a line each, over a stream socket; a dead peer raises nothing, it shows in `closed`.

    Nothing here waits for a peer that does not read, so that a stopped host cannot stop the control loop.
    """

    def __init__(self, connection: socket.socket) -> None:
        connection.setblocking(False)
        self._socket = connection
        self._partial = bytearray()
        self._unsent = bytearray()
        self._sending = threading.Lock()
        self.closed = False
        """Whether the peer is gone."""

    def fileno(self) -> int:
        """For `select`."""
        return self._socket.fileno()

    def send(self, message: Mapping[str, Any]) -> None:
        """Send an object, at once or with a later call as the peer reads; `closed` shows where the peer is gone."""
        line = json.dumps(message, separators=(",", ":")).encode() + b"\n"
        with self._sending:
            self._unsent += line
            self._flush()

    def flush(self, timeout_s: float = FAREWELL_S) -> None:
        """Wait up to `timeout_s` [s] for the peer to read what is yet unsent."""
        deadline = time.monotonic() + timeout_s
        while self.backlog and not self.closed and (left := deadline - time.monotonic()) > 0:
            select.select([], [self._socket], [], left)
            with self._sending:
                self._flush()

    @property
    def backlog(self) -> int:
        """Bytes that the peer was not ready to take yet."""
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
        """The objects that have arrived whole."""
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
        """The objects that arrive within `timeout_s` [s], as soon as there is one; None waits for as long as it takes.

        Raises:
            ComponentFailed: when the peer is gone.
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
        """Hang up."""
        self.closed = True
        self._socket.close()


class Child:
    """The parent's side: a child process, and the channel to it.

    Args:
        module: what the child runs.
        order: the first message, to which `host`, the parent's process id, is added.
        descriptors: what it inherits beside the channel; they stay open here.

    Attributes:
        channel: to the child.
        failed: the event with which it failed; None where it did not say.
    """

    def __init__(self, module: str, order: Mapping[str, Any], *descriptors: int) -> None:
        ours, theirs = socket.socketpair()
        with theirs:
            inherited = (theirs.fileno(), *descriptors)
            # A session of its own: Ctrl-C in the terminal is for the host, which then ends the child in order.
            self._process = subprocess.Popen(
                [sys.executable, "-m", module, *map(str, inherited)],
                pass_fds=inherited,
                stdin=subprocess.DEVNULL,
                start_new_session=True,
            )
        self.channel = Channel(ours)
        self.failed: Mapping[str, Any] | None = None
        self._waiting: list[Mapping[str, Any]] = []
        self.channel.send({**order, "host": os.getpid()})

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    def receive(self) -> list[Mapping[str, Any]]:
        """The messages that have arrived, without log records and failures: those are taken care of."""
        messages, self._waiting = self._waiting, []
        return messages + self._sifted(self.channel.receive())

    def wait(self, timeout_s: float) -> Mapping[str, Any] | None:
        """The next such message, if it arrives within `timeout_s` [s].

        Raises:
            ComponentFailed: when the child is gone.
        """
        if not self._waiting:
            self._waiting = self._sifted(self.channel.wait(timeout_s))
        return self._waiting.pop(0) if self._waiting else None

    def kill(self) -> None:
        """End it at once."""
        self._process.kill()

    def end(self, timeout_s: float) -> bool:
        """Wait up to `timeout_s` [s] for its end, and kill it after; whether it had to be killed."""
        try:
            self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
            return True
        return False

    def cause(self, timeout_s: float) -> str:
        """Why it ended, in its own words where it gave any. It is ended as `end` does."""
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
    """Sends log records to the parent, which owns the terminal; a parent that does not read misses them."""

    def __init__(self, channel: Channel) -> None:
        super().__init__()
        self._channel = channel

    @override
    def emit(self, record: logging.LogRecord) -> None:
        if not self._channel.backlog:
            event = {"event": "log", "logger": record.name, "level": record.levelno, "message": record.getMessage()}
            self._channel.send(event)


def open_parent(descriptor: int) -> Channel:
    """The child's side: the channel to the parent. From now on log records go there; Ctrl-C is for the parent alone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    channel = Channel(socket.socket(fileno=descriptor))
    root = logging.getLogger("ibrobot")
    root.setLevel(logging.INFO)
    root.propagate = False
    root.addHandler(_ToParent(channel))
    return channel

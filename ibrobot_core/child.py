"""Child processes: start them, exchange messages, end them within a time limit, and report why they died.

A child runs `python -m MODULE CHANNEL DESCRIPTOR…` and inherits the descriptors. The first message on the channel is
its order. On the same channel the child reports its log records, and its `Failure` if it fails. Reports have envelopes
of their own, so that nothing in a message can pass for one. Both sides drop lines that are neither.
"""

from __future__ import annotations

import json
import logging
import os
import re
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from typing import Any, override

import attrs

from ibrobot_core.errors import ComponentFailed

FAREWELL_S = 1.0
"""Time for which a child's last messages wait for a parent that does not read [s]."""
_LONGEST = 64 << 20
"""Longest line [bytes]; a peer that sends a longer one, or that leaves more unread, is disconnected."""
_LOGGER = re.compile(r"ibrobot(\.[^\n]{1,100})?")
"""Names of the loggers that a child may use."""
_LEVELS = range(101)
_log = logging.getLogger("ibrobot.child")


@attrs.frozen
class LogLine:
    """A log record of a child."""

    logger: str = attrs.field(validator=attrs.validators.matches_re(_LOGGER))
    level: int = attrs.field(validator=attrs.validators.in_(_LEVELS))
    message: str = attrs.field(validator=attrs.validators.instance_of(str))


@attrs.frozen
class Failure:
    """Why a child fails."""

    error: str = attrs.field(validator=attrs.validators.instance_of(str))
    exit_code: int = attrs.field(default=1, validator=attrs.validators.in_(range(256)))
    """Exit status that the run ends with."""
    holding: list[str] = attrs.field(
        factory=list, validator=attrs.validators.deep_iterable(attrs.validators.instance_of(str))
    )
    """Parts that hold torque, and how to switch it off, one line each."""


Report = LogLine | Failure
"""What a child says about itself, as opposed to its messages."""
_REPORTS: Mapping[str, type[Report]] = {"log": LogLine, "failure": Failure}
_MESSAGE = "message"


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
        self._reports: list[Report] = []
        self.closed = False
        """Whether the peer has closed the connection or died."""
        self.dropped = 0
        """Number of lines of the peer that were neither messages nor reports."""

    def fileno(self) -> int:
        """The socket's descriptor, for `select`."""
        return self._socket.fileno()

    def send(self, message: Mapping[str, Any]) -> None:
        """Send an object without blocking; a later call sends what the peer does not read yet."""
        self._put(_MESSAGE, message)

    def report(self, report: Report) -> None:
        """The child's side: send a report like a message."""
        self._put(next(name for name, kind in _REPORTS.items() if isinstance(report, kind)), attrs.asdict(report))

    def _put(self, envelope: str, content: Mapping[str, Any]) -> None:
        line = json.dumps([envelope, content], separators=(",", ":")).encode() + b"\n"
        with self._sending:
            self._unsent += line
            self._flush()
            self.closed = self.closed or len(self._unsent) > _LONGEST

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
        """The messages that have arrived completely."""
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
            self._partial += received
            self.closed = not received or len(self._partial) > _LONGEST
        if b"\n" not in self._partial:
            return []
        *lines, rest = bytes(self._partial).split(b"\n")
        self._partial = bytearray(rest)
        return [message for line in lines if (message := self._opened(line)) is not None]

    def _opened(self, line: bytes) -> dict[str, Any] | None:
        """The message in a line; None if it is a report, which is kept, or neither, which is counted."""
        try:
            match json.loads(line):
                case ["message", dict() as content]:
                    return content
                case [str() as envelope, dict() as content]:
                    self._reports.append(_REPORTS[envelope](**content))
                    return None
        except (ValueError, TypeError, KeyError, RecursionError):
            pass
        self.dropped += 1
        return None

    def take_reports(self) -> list[Report]:
        """The parent's side: the reports that have arrived since the last call."""
        taken, self._reports = self._reports, []
        return taken

    def wait(self, timeout_s: float | None) -> list[dict[str, Any]]:
        """Wait up to `timeout_s` [s], or without limit if None, for at least one message, or for a report.

        Raises:
            ComponentFailed: if the peer has closed the connection or died.
        """
        while True:
            messages = self.receive()
            if messages or self._reports:
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


def is_stopped(pid: int) -> bool:
    """Whether a process is stopped, e.g. by SIGSTOP or Ctrl-Z; False where the system does not say (no /proc)."""
    try:
        with open(f"/proc/{pid}/stat", encoding="utf-8", errors="replace") as stat:
            return stat.read().rpartition(")")[2].split()[0] in "Tt"
    except OSError:
        return False


class Child:
    """The parent's side of a child process and its channel.

    Args:
        module: the module that the child runs.
        order: the first message, completed by `host`, the parent's process id.
        descriptors: further descriptors for the child; they stay open in the parent.

    Attributes:
        channel: the channel to the child.
        failure: why the child fails; None if it has not said so.
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
        self.failure: Failure | None = None
        self._module = module
        self._told = False
        self._waiting: list[Mapping[str, Any]] = []
        self.channel.send({**order, "host": os.getpid()})

    @property
    def pid(self) -> int:
        """The process id of the child."""
        return self._process.pid

    @property
    def alive(self) -> bool:
        """Whether the child runs. A process forked by it may keep the channel open after its death."""
        return self._process.poll() is None

    def receive(self) -> list[Mapping[str, Any]]:
        """The messages that have arrived. Reports are handled here."""
        messages, self._waiting = [*self._waiting, *self.channel.receive()], []
        self._take_reports()
        return messages

    def wait(self, timeout_s: float) -> Mapping[str, Any] | None:
        """The next message as in `receive`, or None if none arrives within `timeout_s` [s], or before a report.

        Raises:
            ComponentFailed: if the child has died.
        """
        if not self._waiting:
            alive = self.alive
            self._waiting = [*self.channel.wait(timeout_s)]
            self._take_reports()
            if not (alive or self._waiting or self.failure):
                raise ComponentFailed("the process at the other end is gone")
        return self._waiting.pop(0) if self._waiting else None

    def resume(self) -> None:
        """Continue the child if it is stopped, e.g. by SIGSTOP."""
        self._process.send_signal(signal.SIGCONT)

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
        if self.failure is not None:
            return self.failure.error
        status = self._process.returncode
        return f"killed by {signal.Signals(-status).name}" if status < 0 else f"exit status {status}"

    def _take_reports(self) -> None:
        for report in self.channel.take_reports():
            if isinstance(report, Failure):
                self.failure = report
            else:
                logging.getLogger(report.logger).log(report.level, "%s", report.message)
        if self.channel.dropped and not self._told:
            self._told = True
            _log.warning("process %s (%d) sent what is no message; it was dropped", self._module, self.pid)


class _ToParent(logging.Handler):
    """Sends log records to the parent, which owns the terminal; drops them if the parent does not read."""

    def __init__(self, channel: Channel) -> None:
        super().__init__()
        self._channel = channel

    @override
    def emit(self, record: logging.LogRecord) -> None:
        if not self._channel.backlog:
            level = min(max(record.levelno, _LEVELS[0]), _LEVELS[-1])
            self._channel.report(LogLine(record.name, level, record.getMessage()))


def open_parent(descriptor: int) -> Channel:
    """The child's side: open the channel to the parent, send log records there, and leave Ctrl-C to the parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    channel = Channel(socket.socket(fileno=descriptor))
    root = logging.getLogger("ibrobot")
    root.setLevel(logging.INFO)
    root.propagate = False
    root.addHandler(_ToParent(channel))
    return channel

"""Child processes: start them, exchange messages, end them within a time limit, and report why they died.

A child runs `PROGRAM CHANNEL DESCRIPTOR…` and inherits the descriptors. The first message on the channel is its order.
On the same channel the child reports its log records, and its `Failure` if it fails.
"""

from __future__ import annotations

import logging
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, override

import attrs

from ibrobot_core.bug_reports import error_text, exit_code
from ibrobot_core.channel import Channel, ChannelMessage
from ibrobot_core.errors import ComponentFailed

_GLANCE_S = 0.1
"""Period of checking whether a silent child is alive [s]; a process forked by it may keep the channel open."""
_log = logging.getLogger("ibrobot.child")


@attrs.frozen
class LogLine:
    """A log record of a child."""

    logger: str = attrs.field(validator=attrs.validators.matches_re(r"ibrobot(\.[^\n]{1,100})?"))
    level: int = attrs.field(validator=attrs.validators.in_(range(101)))
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


_REPORTS: Mapping[str, type[LogLine | Failure]] = {"log": LogLine, "failure": Failure}


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
        program: the module that the child runs, or the command of another program.
        order: the first message, completed by `host`, the parent's process id.
        descriptors: further descriptors for the child; they stay open in the parent.
        end_s: how long it may take to end [s]; then it is killed.
        options: more arguments of `subprocess.Popen`, e.g. `env`.

    Attributes:
        channel: the channel to the child.
        failure: why the child fails; None if it has not said so.
        end_s: as above.
    """

    def __init__(
        self, program: str | Sequence[str], order: Mapping[str, Any], *descriptors: int, end_s: float, **options: Any
    ) -> None:
        self._program = [sys.executable, "-m", program] if isinstance(program, str) else program
        own_end, child_end = socket.socketpair()
        with child_end:
            inherited = (child_end.fileno(), *descriptors)
            # A new session: Ctrl-C in the terminal reaches the host alone, which then ends the child in an orderly way.
            command = [*self._program, *map(str, inherited)]
            self._process = subprocess.Popen(
                command, pass_fds=inherited, start_new_session=True, stdin=subprocess.DEVNULL, **options
            )
        self.channel = Channel(own_end)
        self.failure: Failure | None = None
        self.end_s = end_s
        self._told = False
        self.channel.send({**order, "host": os.getpid()})

    @property
    def pid(self) -> int:
        """The process id of the child."""
        return self._process.pid

    @property
    def alive(self) -> bool:
        """Whether the child runs. A process forked by it may keep the channel open after its death."""
        return self._process.poll() is None

    def receive(self, timeout_s: float = 0.0) -> list[ChannelMessage]:
        """The messages that have arrived, as from the channel. Reports are handled here."""
        return [message for message in self.channel.receive(timeout_s) if self._is_for_user(message)]

    def wait(self, timeout_s: float) -> ChannelMessage | None:
        """The next message, or None if none arrives within `timeout_s` [s].

        Raises:
            ComponentFailed: with the cause, if the child has failed or died.
        """
        deadline_s = time.monotonic() + timeout_s
        while True:
            alive, left_s = self.alive, max(0.0, deadline_s - time.monotonic())
            message = self.channel.next(min(left_s, _GLANCE_S))
            if message is not None:
                if self._is_for_user(message):
                    return message
            elif self.failure is not None:
                raise ComponentFailed(self.failure.error)
            elif self.channel.closed or not alive:
                raise ComponentFailed(self.cause())
            elif not left_s:
                return None

    def resume(self) -> None:
        """Continue the child if it is stopped, e.g. by SIGSTOP."""
        self._process.send_signal(signal.SIGCONT)

    def kill(self) -> None:
        """Kill the child."""
        self._process.kill()

    def end(self) -> bool:
        """Wait up to `end_s` for the child to end, then kill it; return whether it was killed."""
        try:
            self._process.wait(self.end_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
            return True
        return False

    def cause(self) -> str:
        """End the child as `end` does, and return why it ended: its own error if it sent one, else its exit status."""
        self.end()
        if self.failure is not None:
            return self.failure.error
        status = self._process.returncode
        return f"killed by {signal.Signals(-status).name}" if status < 0 else f"exit status {status}"

    def _is_for_user(self, message: ChannelMessage) -> bool:
        """Whether it is a message; otherwise it is a report, which is taken, or dropped if it is malformed."""
        try:
            report = None if message.word == "message" else _REPORTS[message.word](**message)
        except (KeyError, TypeError, ValueError):
            report, self.channel.dropped = None, self.channel.dropped + 1
        if isinstance(report, Failure):
            self.failure = report
        elif report is not None:
            logging.getLogger(report.logger).log(report.level, "%s", report.message)
        if self.channel.dropped and not self._told:
            self._told = True
            _log.warning("process %s (%d) sent what is no message; it was dropped", self._program[-1], self.pid)
        return message.word == "message"


class _ToParent(logging.Handler):
    """Sends log records to the parent, which owns the terminal; drops them if the parent does not read."""

    def __init__(self, channel: Channel) -> None:
        super().__init__()
        self._channel = channel

    @override
    def emit(self, record: logging.LogRecord) -> None:
        if not self._channel.backlog:
            line = LogLine(record.name, min(max(record.levelno, 0), 100), record.getMessage())
            self._channel.send(attrs.asdict(line), word="log")


def run_child(work: Callable[..., None], holding: Sequence[str] = ()) -> int:
    """The child's side: do the work of the parent's order, and report why it fails. Returns the exit status.

    Log records go to the parent, which Ctrl-C is left to.

    Args:
        work: called with the channel, the order, and the descriptors that follow on the command line.
        holding: as in `Failure`, once the work has failed.
    """
    parent, *descriptors = map(int, sys.argv[1:])
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    channel = Channel(socket.socket(fileno=parent))
    root = logging.getLogger("ibrobot")
    root.setLevel(logging.INFO)
    root.propagate = False
    root.addHandler(_ToParent(channel))
    try:
        if (order := channel.next(None)) is not None:
            work(channel, order, *descriptors)
    except Exception as error:  # noqa: BLE001 - the parent reports it
        failure = Failure(error_text(error) or type(error).__name__, exit_code(error), [*holding])
        channel.send(attrs.asdict(failure), word="failure")
        return 1
    finally:
        channel.flush()
    return 0

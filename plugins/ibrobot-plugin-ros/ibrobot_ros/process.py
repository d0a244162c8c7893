"""The process of the node, seen from the run."""

from __future__ import annotations

import signal
import socket
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

import attrs

from ibrobot_core.api import MissingDependency
from ibrobot_core.app import ComponentFailed
from ibrobot_ros.installation import REMEDY, Interpreter, environment, find_interpreter
from ibrobot_ros.options import RosInstallation
from ibrobot_ros.wire import Wire

_SCRIPT = Path(__file__).parent / "node" / "run.py"
_START_S = 30.0
_GLANCE_S = 0.1
_END_S = 2.0
_SAID = 2000
"""Number of characters of the node's output that its cause of death quotes."""


@attrs.frozen
class Hello:
    """What the node found."""

    python: str
    rclpy: str
    distro: str
    rmw: str
    domain: str
    range: str
    interfaces: tuple[str, ...] = attrs.field(converter=tuple)

    def __str__(self) -> str:
        name = f"ROS 2 {self.distro}".rstrip()
        reach = self.range.lower() or "as ROS decides"
        return f"{name} with {self.rmw}, domain {self.domain}, discovery {reach}, {self.python}"


class NodeProcess:
    """Starts the node and waits until it is there.

    Args:
        options: which ROS.
        name: name of the node.
        niceness: how much the rest of the machine comes first, as for `nice`.
        probe: whether it only says what it finds.
        given_up: called while waiting; whether to stop waiting.

    Attributes:
        wire: the connection.
        hello: what the node found.
        printed: the last that it printed; known after `end`.

    Raises:
        MissingDependency: if there is no rclpy.
        ComponentFailed: if it dies or is silent.
    """

    def __init__(
        self, options: RosInstallation, name: str, *, niceness: int = 0, probe: bool = False,
        given_up: Any = lambda: False,
    ) -> None:  # fmt: skip
        self.printed = ""
        interpreter = find_interpreter(options)
        own, other = socket.socketpair()
        self._said = tempfile.TemporaryFile()  # noqa: SIM115 - closed by `end`
        with other:
            self._process = subprocess.Popen(
                [*interpreter.command, str(_SCRIPT), str(other.fileno())],
                pass_fds=(other.fileno(),),
                stdin=subprocess.DEVNULL,
                stdout=self._said,
                stderr=self._said,
                start_new_session=True,
                env=environment(options, interpreter),
            )
        self.wire = Wire(own)
        self.wire.send({"op": "order", "name": name, "niceness": niceness, "probe": probe})
        try:
            self.hello = self._await_hello(interpreter, given_up)
        except BaseException:
            self.end()
            raise

    def _await_hello(self, interpreter: Interpreter, given_up: Any) -> Hello:
        deadline_s = time.monotonic() + _START_S
        while not self.wire.closed and time.monotonic() < deadline_s and not given_up():
            for head, _ in self.wire.wait(_GLANCE_S):  # one, since the node then waits for an order
                if head.pop("op") == "hello":
                    return Hello(**head)
                raise MissingDependency(
                    f"rclpy cannot be imported by {head['python']} ({interpreter.found}): {head['what']}", remedy=REMEDY
                )
        raise ComponentFailed(f"the ROS node did not start ({interpreter.found}): {self.cause()}")

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    def cause(self) -> str:
        """End the process; why it ended: its exit status, and the last that it printed."""
        self.end()
        status = self._process.returncode
        cause = f"killed by {signal.Signals(-status).name}" if status < 0 else f"exit status {status}"
        return ": ".join(filter(None, (cause, self.printed)))

    def end(self) -> None:
        """End the process; safe to call twice. Nothing may wait on the wire meanwhile."""
        self.wire.close()
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        if not self._said.closed:
            size = self._said.seek(0, 2)
            self._said.seek(max(0, size - _SAID))
            self.printed = self._said.read().decode(errors="replace").strip()
            self._said.close()

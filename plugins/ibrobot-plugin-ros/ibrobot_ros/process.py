"""The process of the node, seen from the run."""

from __future__ import annotations

import inspect
import os
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import override

import attrs

from ibrobot_core.api import MissingDependency
from ibrobot_core.app import Channel, Child, ComponentFailed
from ibrobot_ros.installation import REMEDY, Interpreter, environment, find_interpreter
from ibrobot_ros.options import RosInstallation

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


class NodeProcess(Child):
    """Starts the node and waits until it is there.

    Args:
        options: which ROS.
        name: name of the node.
        niceness: how much the rest of the machine comes first, as for `nice`.
        probe: whether it only says what it finds.
        given_up: called while waiting; whether to stop waiting.

    Attributes:
        hello: what the node found.

    Raises:
        MissingDependency: if there is no rclpy.
        ComponentFailed: if it dies or is silent.
    """

    def __init__(
        self, options: RosInstallation, name: str, *, niceness: int = 0, probe: bool = False,
        given_up: Callable[[], bool] = lambda: False,
    ) -> None:  # fmt: skip
        interpreter = find_interpreter(options)
        self._printed = tempfile.TemporaryFile()  # noqa: SIM115 - closed by `close`
        super().__init__(
            [*interpreter.command, str(_SCRIPT), inspect.getfile(Channel)],
            {"op": "order", "name": name, "niceness": niceness, "probe": probe},
            end_s=_END_S, env=environment(options, interpreter), stdout=self._printed, stderr=self._printed,
        )  # fmt: skip
        try:
            self.hello = self._await_hello(interpreter, given_up)
        except BaseException:
            self.close()
            raise

    def _await_hello(self, interpreter: Interpreter, given_up: Callable[[], bool]) -> Hello:
        deadline_s = time.monotonic() + _START_S
        head = None
        with suppress(ComponentFailed):
            while head is None and time.monotonic() < deadline_s and not given_up():
                head = self.wait(_GLANCE_S)
        if head is None:
            self.channel.close()
            raise ComponentFailed(f"the ROS node did not start ({interpreter.found}): {self.cause()}")
        if head.pop("op") == "hello":
            return Hello(**head)
        raise MissingDependency(
            f"rclpy cannot be imported by {head['python']} ({interpreter.found}): {head['what']}", remedy=REMEDY
        )

    @override
    def cause(self) -> str:
        """End the process; why it ended: its exit status, and the last that it printed."""
        cause = super().cause()
        if self._printed.closed:
            return cause
        self._printed.seek(max(0, self._printed.seek(0, os.SEEK_END) - _SAID))
        return ": ".join(filter(None, (cause, self._printed.read().decode(errors="replace").strip())))

    def close(self) -> None:
        """End the process; safe to call twice. Nothing may wait on the channel meanwhile."""
        self.channel.close()
        self.end()
        self._printed.close()

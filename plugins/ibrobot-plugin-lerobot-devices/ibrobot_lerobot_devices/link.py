"""The parent's side of a device process: start it, ask it for readings, send it actions, end it."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from importlib.util import find_spec
from typing import Any

from ibrobot_core.api import how_to_install
from ibrobot_core.app import ChannelMessage, Child, ComponentFailed
from ibrobot_lerobot_devices.device import ANSWER, CONNECT, DONE, END, READY, STAND, TRAFFIC

INSTALL = how_to_install("lerobot")
"""The command that installs LeRobot; its devices need extras, e.g. `lerobot[feetech]`."""
_MODULE = "ibrobot_lerobot_devices.device"
_FAREWELL_S = 1.0
"""How long a call may go on after the parent has ended or died [s]."""
_END_S = 0.5
"""How much longer the device process may take to end [s]; then it is killed."""
_TRAFFIC_S = 0.02
"""Wait of a fault for the report of the ports' traffic [s]."""
_MANY = 1 << 16
"""Unread bytes from which on actions are dropped: LeRobot's call has blocked for seconds."""


class DeviceProblem(Exception):
    """A device process cannot do what it is asked; the text is for the operator."""


def is_installed() -> bool:
    """Whether LeRobot is installed in this environment."""
    return find_spec("lerobot") is not None


def age_ns(answer: Mapping[str, Any]) -> int:
    """How long ago an answer was made [ns]."""
    return time.monotonic_ns() - int(answer["made_ns"])


class DeviceLink:
    """A device of LeRobot's in a process of its own.

    Args:
        kind: robot, teleoperator or camera.
        type: LeRobot's name of the device.
        config: its config, without `type`.
        torch: whether the process loads torch.
        only_make: whether it ends after it has said what the device is, without a connection.
    """

    def __init__(
        self, kind: str, type: str, config: Mapping[str, Any], *, torch: bool = False, only_make: bool = False
    ) -> None:
        self._order = {
            "kind": kind, "type": type, "config": dict(config), "torch": torch, "only_make": only_make, "waits": False,
        }  # fmt: skip
        self.type = type
        self._child: Child | None = None
        self._standby: Child | None = None
        """A process that has imported LeRobot and waits, to take the place of one that dies."""
        self._number = 0
        self._asked_s: float | None = None
        """When the request without an answer was sent [s]; None if there is none."""
        self.late = 0
        """How many readings came after the tick that asked for them."""
        self._stood: str | None = None
        self.refused = (0, "")
        """How many actions in a row LeRobot has not carried out, and why."""

    @property
    def pid(self) -> int | None:
        """The id of the process; None if there is none."""
        return self._child.pid if self._child is not None else None

    def start(self, timeout_s: float) -> Mapping[str, Any]:
        """Start the process, connect the device, and return what it says about itself.

        Raises:
            DeviceProblem: if LeRobot is not installed, or the device cannot be connected.
        """
        self.begin()
        try:
            answer = self.poll_start(timeout_s)
            if answer is None:
                raise DeviceProblem(f"LeRobot does not connect it within {timeout_s:g} s")
            return answer
        except BaseException:
            self.end()
            raise

    def begin(self) -> None:
        """Start the process, which connects the device; `poll_start` waits for that."""
        if not is_installed():
            raise DeviceProblem(f"LeRobot is not installed here: {INSTALL}")
        self._end_child()
        if self._standby is not None and self._standby.alive:
            self._child, self._standby = self._standby, None
            self._child.channel.send({"do": CONNECT})
        else:
            self._child = self._start(self._order)
        self._asked_s, self._stood, self.refused = None, None, (0, "")

    def prepare(self) -> None:
        """Start a process that waits, so that `begin` takes a fraction of a second, if none waits yet."""
        if self._standby is None or not self._standby.alive:
            self._end_standby()
            self._standby = self._start({**self._order, "waits": True})

    def _start(self, order: Mapping[str, Any]) -> Child:
        return Child(_MODULE, {**order, "farewell_s": _FAREWELL_S}, end_s=_FAREWELL_S + _END_S)

    def poll_start(self, timeout_s: float) -> Mapping[str, Any] | None:
        """What the device says about itself, once it is connected; None if that takes more than `timeout_s` [s].

        Raises:
            DeviceProblem: if it cannot be connected.
        """
        return self._await(READY, timeout_s)

    def read(self, wait_s: float) -> ChannelMessage | None:
        """The newest answer that was not returned yet; asks for one, and waits up to `wait_s` [s] for it.

        A request that is not answered yet is not repeated.

        Raises:
            DeviceProblem: if the process has died.
        """
        newest = None
        while (answer := self._next(0.0)) is not None:  # those that came after their tick
            newest = answer
        self.late += newest is not None
        if self._asked_s is None:
            self._ask("read")
        deadline_s = time.monotonic() + wait_s
        while self._asked_s is not None and (left_s := deadline_s - time.monotonic()) > 0:
            answer = self._next(left_s)
            newest = answer if answer is not None else newest
        return newest

    def picture(self, timeout_s: float) -> ChannelMessage | None:
        """The next answer with a picture, or with an error, or None if none arrives within `timeout_s` [s].

        Raises:
            DeviceProblem: if the process has died.
        """
        if self._asked_s is None:
            self._ask("picture")
        deadline_s = time.monotonic() + timeout_s
        while True:
            answer = self._next(max(0.0, deadline_s - time.monotonic()))
            if answer is not None or time.monotonic() >= deadline_s:
                return answer

    def _ask(self, what: str) -> None:
        self._number += 1
        self._asked_s = time.monotonic()
        self._running().channel.send({"do": what, "id": self._number})

    @property
    def blocked_s(self) -> float:
        """How long the present call of LeRobot's has taken, if a reading waits for it [s]."""
        return 0.0 if self._asked_s is None else time.monotonic() - self._asked_s

    def blockage(self, call: str) -> str:
        """What is known of the present call of LeRobot's, e.g. `get_observation`, which does not return."""
        text = f"LeRobot's {self.type}.{call} does not return for {self.blocked_s:.2f} s"
        try:
            return f"{text}{self._traffic()}"
        except DeviceProblem as problem:  # the process has died
            return str(problem)

    def _traffic(self) -> str:
        """Traffic from the device's ports during the present call, in words."""
        self._running().channel.send({"do": TRAFFIC})
        deadline_s = time.monotonic() + _TRAFFIC_S
        while (left_s := deadline_s - time.monotonic()) > 0:
            message = self._message(left_s)
            if message is None or message["event"] != TRAFFIC:
                continue
            if message["received"]:
                return (
                    f": {message['received']} bytes have come from its port, but no valid answer of all motors; "
                    "check the cables, and that no other program uses the port"
                )
            if message["reads"]:
                return ": nothing comes from its port; check the motors' power and cable"
            return ""
        return ", and its process does not respond"

    def act(self, action: Mapping[str, float]) -> None:
        """Send an action; LeRobot gets the newest one when its present call has returned.

        Raises:
            DeviceProblem: if the process has died.
        """
        channel = self._running().channel
        if channel.backlog < _MANY:
            channel.send({"do": "act", "action": dict(action), "made_ns": time.monotonic_ns()})

    def stand(self) -> str | None:
        """Ask LeRobot to let the base stand; does not wait. Continues a process that is stopped.

        Returns:
            The newest answer to this or to an earlier call: empty if the base stands, else why LeRobot cannot stop it;
            None if none has come since the last call.

        Raises:
            DeviceProblem: if the process has died.
        """
        child = self._running()
        child.resume()
        if child.channel.backlog < _MANY:
            child.channel.send({"do": STAND})
        self._stood = None
        while self._message(0.0) is not None and self._stood != "":
            pass
        return self._stood

    def kill(self) -> None:
        """Kill the process, whose call of LeRobot's does not return."""
        if self._child is not None:
            self._child.kill()
        self._end_child()

    def call(self, what: str, timeout_s: float) -> Any:
        """Carry a request out: `relax`, `hold` or `reconnect`; returns its result.

        Raises:
            DeviceProblem: if it fails, or takes more than `timeout_s` [s].
        """
        self._running().channel.send({"do": what})
        answer = self._await(what, timeout_s)
        if answer is None:
            raise DeviceProblem(f"a call of LeRobot's blocks: {what} is not done after {timeout_s:g} s")
        self.refused = (0, "")
        return answer

    def end(self) -> bool:
        """End the process; safe at any time. Returns whether it has released its device, so that a base stands."""
        self._end_standby()
        return self._end_child()

    def _end_child(self) -> bool:
        child, self._child = self._child, None
        if child is None:
            return True
        child.channel.send({"do": "end"})
        if child.end():
            logging.getLogger("ibrobot.lerobot").warning("%s did not end, and was killed", self.type)
        said = child.receive()  # also what it has logged
        child.channel.close()
        return any(message["event"] == END for message in said)

    def _end_standby(self) -> None:
        standby, self._standby = self._standby, None
        if standby is not None:
            standby.kill()  # it has touched nothing
            standby.end()
            standby.channel.close()

    def _running(self) -> Child:
        if self._child is None:
            raise DeviceProblem("is not connected")
        return self._child

    def _next(self, timeout_s: float) -> ChannelMessage | None:
        """The next answer to a request to read; None if none arrives in time."""
        message = self._message(timeout_s)
        if message is None or message["event"] != ANSWER:
            return None
        return message

    def _await(self, what: str, timeout_s: float) -> Mapping[str, Any] | None:
        """The result of a request, or of the start; None if there is none in time."""
        deadline_s = time.monotonic() + timeout_s
        while (message := self._message(max(0.0, deadline_s - time.monotonic()))) or time.monotonic() < deadline_s:
            if message and (message["event"] == READY or (message["event"] == DONE and message["do"] == what)):
                if "error" in message:
                    raise DeviceProblem(message["error"])
                return dict(message["found"])
        return None

    def _message(self, timeout_s: float) -> ChannelMessage | None:
        child = self._running()
        try:
            message = child.wait(timeout_s)
        except ComponentFailed as death:
            self._end_child()
            raise DeviceProblem(f"{'' if child.failure else "LeRobot's process has ended: "}{death}") from None
        if message is not None and message["event"] == ANSWER and message["id"] == self._number:
            self._asked_s = None
        if message is not None and message["event"] == DONE:
            if message["do"] == "act":  # only those that fail are answered
                self.refused = (message["times"], message["error"])
            elif message["do"] == STAND:
                self._stood = message.get("error", "")
        return message

"""Teleop: reads the devices at every state of control, and sends control plans of one setpoint."""

from __future__ import annotations

from typing import override

import numpy as np

from ibrobot_core.component import SourceWorker
from ibrobot_core.errors import TeleopError
from ibrobot_core.interfaces.run import StreamingRun
from ibrobot_core.launch.sources.operator_devices import OperatorDevices
from ibrobot_core.schema import ControlMode


class TeleopSource(SourceWorker):
    """The teleoperation devices of a mode, which command the robot by plans as all command sources do.

    A failure of a device while the robot follows it is a fault, so that all joints stop together; a reset connects the
    device again.
    """

    session: StreamingRun
    sends_stops = True
    urgent = True

    def __init__(self, session: StreamingRun, mode: ControlMode) -> None:
        self._devices = OperatorDevices(session, mode.devices)
        self._commands = False
        """Whether the last plan has joints; one without any lets them brake."""
        self._whole = {name: session.config.executors[name].joints for name in mode.executors}
        """Executor -> its joints; without those that hold since a device leaves joints out."""
        super().__init__(session, mode, f"teleop {self._devices}")

    @override
    def setup(self) -> None:
        self.on_end.callback(self._devices.disconnect)
        self._devices.connect()
        self._states = self.session.watch_states()  # also while the joints do not answer: a device may stop the robot

    @override
    def recover(self) -> None:
        with self._devices.pulse.paused(), self.lock:
            self._devices.recover()

    @override
    def begin_mode(self, seed: int) -> None:
        self.session.followed_ns = 0
        self._commands = False
        self._devices.activate(self.session.measured())

    @override
    def work(self, timeout_s: float) -> None:
        self._devices.pulse.beat()
        if self._states.get(timeout_s) is None:
            return
        with self.lock:
            if self.active:
                self._follow()

    def _follow(self) -> None:
        session = self.session
        try:
            command = self._devices.read(session.measured())
        except TeleopError as error:
            self.end()
            if not session.finished.is_set():
                session.raise_fault(str(error))
            return
        if session.finished.is_set():
            return  # from here on, only emergency stops count
        positions = command.positions or {}
        if positions or self._commands:
            session.send_plan(session.clock.now_ns(), 1, tuple(positions), np.array([[*positions.values()]]))
        self._commands = bool(positions)
        for executor, joints in [*self._whole.items()] if positions else ():
            if (left_out := [each for each in joints if each not in positions]) and len(left_out) < len(joints):
                del self._whole[executor]
                text = "%s leaves %s of executor %s out, so its other joints hold, too: a device commands all or none"
                session.log.warning(text, self._devices, ", ".join(left_out), executor)
        if command.positions and not command.approaching:
            session.followed_ns = session.clock.now_ns()
        for event in command.events:
            if event == "intervention":
                session.log.warning("%s: mode %s has no policy to take the robot from", event, self.mode.name)
            else:
                session.pass_on(event)
        if command.finished:
            session.finish()

    @override
    def help(self) -> str:
        return self._devices.help()

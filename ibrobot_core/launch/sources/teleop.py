"""Teleop: reads the device at every joint state, and sends control plans of one setpoint."""

from __future__ import annotations

from typing import override

import numpy as np

from ibrobot_core.config.schema import ControlMode
from ibrobot_core.errors import TeleopError
from ibrobot_core.interfaces import OperatorEvent, Teleop
from ibrobot_core.launch.session import Session
from ibrobot_core.launch.sources.source_worker import SourceWorker


class TeleopSource(SourceWorker):
    """A teleoperation device, which commands the robot by plans as all command sources do.

    A failure of the device while the robot follows it is a fault; a reset connects the device again.
    """

    def __init__(self, session: Session, mode: ControlMode, device: str) -> None:
        component = session.config.teleoperation[device]
        super().__init__(session, mode, f"teleop {device} ({component.type})")
        self._device_name = device
        self._component = component
        self._lost = False

    @override
    def setup(self) -> None:
        self._device: Teleop = self.session.make("teleop", self._component, self._device_name)
        self.on_end.callback(self._device.disconnect)
        self._device.connect()
        self._states = self.session.bus.subscribe("/joint_states", 1)
        self.on_end.callback(self._states.close)

    @override
    def recover(self) -> None:
        with self.lock:
            if self._lost:
                self._device.disconnect()
                self._device.connect()
                self._lost = False

    @override
    def begin_mode(self, seed: int) -> None:
        self._device.activate(self.session.measured())

    @override
    def work(self, timeout_s: float) -> None:
        if self._states.get(timeout_s) is None:
            return
        with self.lock:
            if self.active:
                self._follow()

    def _follow(self) -> None:
        session = self.session
        try:
            command = self._device.read(session.measured())
        except TeleopError as error:
            self._lost = True
            self.end()
            session.control.call("fault", fault=str(error))
            return
        if command.estop:
            session.control.call("estop")
        elif command.positions:
            joints = tuple(command.positions)
            setpoint = np.array([list(command.positions.values())])
            session.send_plan(session.clock.now_ns(), 1, joints, setpoint)
        for event in command.events:
            self._pass_on(event)
        if command.finished:
            session.finish()

    def _pass_on(self, event: OperatorEvent) -> None:
        session = self.session
        if event == "intervention":
            session.log.warning("%s: mode %s has no policy to take the robot from", event, self.mode.name)
        elif not session.request.by_operator:
            session.log.warning("%s: this run records no episodes by hand", event)
        else:
            session.operator_events.put(event)

    @override
    def help(self) -> str:
        return self._device.help()

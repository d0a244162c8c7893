"""Teleop: reads the devices at every joint state, and sends control plans of one setpoint."""

from __future__ import annotations

from typing import override

import attrs
import numpy as np
from numpy.typing import NDArray

from ibrobot_core.config.schema import ControlMode
from ibrobot_core.errors import TeleopError
from ibrobot_core.interfaces import OperatorEvent, Teleop, TeleopCommand
from ibrobot_core.launch.session import Session
from ibrobot_core.launch.sources.source_worker import SourceWorker


@attrs.define(eq=False)
class _Connected:
    """A device, and the indices of the joints that it sees and moves."""

    name: str
    device: Teleop
    columns: NDArray[np.intp]
    joints: frozenset[str]
    lost: bool = False


class TeleopSource(SourceWorker):
    """The teleoperation devices of a mode, which command the robot by plans as all command sources do.

    Each device sees its group of joints as the whole robot. A failure of one while the robot follows it is a fault, so
    that all joints stop together; a reset connects the device again.
    """

    def __init__(self, session: Session, mode: ControlMode) -> None:
        types = session.config.teleoperation
        texts = [
            f"{name} ({types[name].type})" + (f" moves {group}" if group else "")
            for group, name in mode.devices.items()
        ]
        super().__init__(session, mode, f"teleop {', '.join(texts)}")
        self._connected: list[_Connected] = []

    @override
    def setup(self) -> None:
        robot = self.session.config.robot
        for group, name in self.mode.devices.items():
            part = robot.part(group) if group else robot
            device = self.session.make("teleop", self.session.config.teleoperation[name], name, robot=part)
            self.on_end.callback(device.disconnect)
            device.connect()
            self._connected.append(
                _Connected(name, device, robot.indices(part.joint_names), frozenset(part.joint_names))
            )
        self._states = self.session.bus.subscribe("/joint_states", 1)
        self.on_end.callback(self._states.close)

    @override
    def recover(self) -> None:
        with self.lock:
            for each in self._connected:
                if each.lost:
                    each.device.disconnect()
                    each.device.connect()
                    each.lost = False

    @override
    def begin_mode(self, seed: int) -> None:
        measured = self.session.measured()
        for each in self._connected:
            each.device.activate(measured.of(each.columns))

    @override
    def work(self, timeout_s: float) -> None:
        if self._states.get(timeout_s) is None:
            return
        with self.lock:
            if self.active:
                self._follow()

    def _follow(self) -> None:
        session = self.session
        commands = self._read()
        if any(command.estop for command in commands):
            session.control.call("estop")
        elif positions := {joint: at for command in commands for joint, at in (command.positions or {}).items()}:
            setpoint = np.array([list(positions.values())])
            session.send_plan(session.clock.now_ns(), 1, tuple(positions), setpoint)
        for event in (event for command in commands for event in command.events):
            self._pass_on(event)
        if commands and all(command.finished for command in commands):
            session.finish()

    def _read(self) -> list[TeleopCommand]:
        """The command of each device; none, and a fault, if a device has failed."""
        measured = self.session.measured()
        commands, faults = [], []
        for each in self._connected:
            try:
                command = each.device.read(measured.of(each.columns))
                if strange := set(command.positions or ()) - each.joints:
                    raise TeleopError(
                        f"{each.name}: commands joints that are not its own: {', '.join(sorted(strange))}"
                    )
                commands.append(command)
            except TeleopError as error:
                each.lost = True
                faults.append(str(error))
        if not faults:
            return commands
        self.end()
        self.session.control.call("fault", fault="; ".join(faults))
        return []

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
        return "\n".join(filter(None, (each.device.help() for each in self._connected)))

"""The control component: starts the process (or, in lockstep, the loop) that owns the hardware."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from typing import Any, override

import numpy as np
from numpy.typing import NDArray

from ibrobot_core.clock import RealClock, SteppedClock
from ibrobot_core.component import CONTROL, Component
from ibrobot_core.control.host import ControlClient, ControlHost, InlineControl
from ibrobot_core.deadman import LONGEST_BRAKING_S
from ibrobot_core.descriptors import HardwareDescriptor
from ibrobot_core.errors import ComponentFailed, HardwareError
from ibrobot_core.interfaces.run_state import ControlState
from ibrobot_core.launch.session import Session
from ibrobot_core.messages import JOINT_STATES, Float64MultiArray, Header, JointState, String
from ibrobot_core.pulses import Pulse
from ibrobot_core.schema import ControlMode, RobotConfig

_PATIENCE_S = 1.0
"""Time after the end of a run was asked for in which the main thread begins to stop it [s]."""


class ControlComponent(Component):
    """Starts control and publishes joint states, commands and signals."""

    def __init__(self, session: Session, needs: tuple[str, ...]) -> None:
        config = session.config
        where = "in this process, in lockstep" if session.request.lockstep else "in a process of its own"
        simulation = config.simulation if config.simulated else None
        types = [simulation.type] if simulation else [each.type for each in config.hardware.values()]
        guard = f", guarded by {config.control.guard.type}" if config.control.guard is not None else ""
        super().__init__(CONTROL, f"{', '.join(types)} at {config.control.rate_hz:g} Hz, {where}{guard}", needs)
        self._session = session
        self._joints = config.robot.joint_names
        self._checked_s = self._ending_s = 0.0
        self._held = False
        self._actions = {name: tuple(_action_topics(config, mode)) for name, mode in config.control_modes.items()}

    @override
    def start(self) -> None:
        session = self._session
        host: ControlHost
        if isinstance(session.clock, SteppedClock):
            host = InlineControl(
                session.config, session.registry, session.clock, session.request.seed, self._publish, self._take
            )
        else:
            assert isinstance(session.clock, RealClock)
            host = ControlClient(
                session.config, session.clock, session.request.seed, self._publish, self._take,
                lambda error: session.fail(CONTROL, error), given_up=session.finished, aftermath=_aftermath(session),
            )  # fmt: skip
        session.control = host
        host.start()
        for line in host.refused:
            session.log.warning(line)
        braking_s, names = session.config.robot.braking_s, self._joints
        if braking_s.max() > LONGEST_BRAKING_S:
            slowest = names[int(braking_s.argmax())]
            session.log.warning("STOP: %s brakes from full speed for %.2f s", slowest, braking_s.max())

    def arrive(self) -> None:
        """Wait until the robot has arrived at its startup pose.

        Raises:
            IbrobotError: as `ControlHost.arrive`.
        """
        self._session.control.arrive()
        self._session.generation = self._session.control.generation

    @override
    def step(self, now_ns: int) -> None:
        host = self._session.control
        assert isinstance(host, InlineControl)
        host.step()

    @override
    def stop(self) -> None:
        session = self._session
        if session.has_control:
            session.control.stop(unmoved=session.start_failed)
            session.outcome.holding = session.control.holding

    def _publish(self, state: ControlState) -> None:
        session = self._session
        session.take_state(state)
        if isinstance(session.control, ControlClient):
            self._check_threads(session.control)
        bus = session.bus
        if not state.stale:  # what was not measured is missing, not repeated
            header = Header(state.stamp_ns)
            effort = state.effort if np.isfinite(state.effort).all() else np.empty(0)
            bus.publish(JOINT_STATES, JointState(header, self._joints, state.position, state.velocity, effort))
        for topic, columns in self._actions[session.mode]:
            bus.publish(topic, Float64MultiArray(state.command[columns]))
        if state.stale:
            return
        begin = 0
        for topic, size in session.control.signals:
            bus.publish(topic, Float64MultiArray(state.signals[begin : begin + size].copy()))
            begin += size

    def _check_threads(self, control: ControlClient) -> None:
        """End the run if a thread that a STOP goes through hangs; have the robot hold if the main thread does not."""
        session, now_s = self._session, time.monotonic()
        if now_s - self._checked_s < Pulse.period_s:
            return
        passed_s, self._checked_s = now_s - self._checked_s, now_s
        for late in [pulse for pulse in set(session.pulses) if pulse.is_late(passed_s)]:
            failure = f"does not react for {late.longest_s:g} s: STOP would be late there"
            session.fail(late.name, ComponentFailed(failure))
        ending = session.finished.is_set() and not session.stopping.is_set()
        self._ending_s = self._ending_s + min(passed_s, 2 * Pulse.period_s) if ending else 0.0
        if self._ending_s > _PATIENCE_S and not self._held:
            self._held = True
            control.raise_fault("the run ends, but its main thread is busy")

    def _take(self, event: Mapping[str, Any]) -> None:
        session = self._session
        if event["event"] == "goal":
            for call in tuple(session.on_goal):
                call(event)
        elif event["event"] == "guard":
            session.bus.publish("/guard", String(event["overruled"]), latched=True)
        elif event["event"] == "fault":
            fault = str(event["fault"])
            session.add_fault(fault, int(event["generation"]))
            session.log.error("fault: %s; the robot %s", fault, event["then"])
            session.emit("ibrobot_fault_raised", fault=fault, stamp_ns=int(event["stamp_ns"]))
        else:
            raise HardwareError(f"control sent an unknown event {event['event']!r}")


def _action_topics(config: RobotConfig, mode: ControlMode) -> Iterator[tuple[str, NDArray[np.intp]]]:
    """Topic and columns of each action whose joints a mode moves, by whichever executors."""
    loaded = [config.executors[name] for name in mode.executors if name in config.executors]  # not all, if unavailable
    moved = {joint for executor in loaded for joint in executor.joints}
    for spec in config.contract.actions:
        joints = config.executors[spec.executor].joints
        if moved.issuperset(joints):
            yield spec.topic, config.robot.indices(joints)


def _aftermath(session: Session) -> str:
    """The advice for hardware that no process commands now."""
    commands: dict[str, None] = {}
    for part in () if session.config.simulated else session.config.hardware.values():
        descriptor = session.registry.find("hardware", part.type)
        assert isinstance(descriptor, HardwareDescriptor)
        if descriptor.torque_off:
            commands[f"`{descriptor.torque_off}`"] = None
    return f"; if joints still hold, {' and '.join(commands)} takes their torque off" if commands else ""

"""A small robot of three joints on fake hardware, and its control core, ticked by hand."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, override

import attrs
import numpy as np
import pytest
import yaml
from ibrobot_testing.contexts import START_NS
from ibrobot_testing.fakes import FakeHardware, FakeRealHardware, FakeTrajectoryExecutor

from ibrobot_core.clock import SteppedClock
from ibrobot_core.config import RobotConfig, from_document
from ibrobot_core.control.commands import Command
from ibrobot_core.control.core import ControlCore
from ibrobot_core.descriptors import ExecutorDescriptor, HardwareDescriptor
from ibrobot_core.errors import HardwareError
from ibrobot_core.interfaces import Context, JointReading, Torque
from ibrobot_core.interfaces.hardware import Condition, Holding
from ibrobot_core.interfaces.run_state import ControlState, PlanRecord
from ibrobot_core.plugins import Entry, Registry, discover
from ibrobot_core.robot import Vector

PERIOD_S = 0.01
DOCUMENT = """
robot:
  name: mini
  joints:
    - {name: pan, lower: -1.0, upper: 1.0, max_velocity: 3.0, max_acceleration: 40.0}
    - {name: lift, lower: -1.5, upper: 1.5, max_velocity: 3.0, max_acceleration: 40.0}
    - {name: grip, lower: 0.0, upper: 1.0, max_velocity: 3.0, max_acceleration: 40.0}
  groups: {arm: [pan, lift], gripper: [grip]}
  description:
    poses: {rest: [-0.8, 1.0, 0.1]}
hardware: {type: scripted}
simulation: {type: scene}
executors:
  arm_position: {type: position, group: arm}
  gripper_position: {type: position, group: gripper}
  arm_trajectory: {type: waypoints, group: arm}
  gripper_action: {type: waypoints, group: gripper}
control_modes:
  stream: {executors: [arm_position, gripper_position]}
  plan: {executors: [arm_trajectory, gripper_action]}
default_control_mode: stream
control: {rate_hz: 100, stop: hold, state_timeout: 0.05}
"""


class ScriptedHardware(FakeHardware):
    """Fails on request, and keeps what was written to it."""

    def __init__(self, ctx: Context) -> None:
        super().__init__(ctx)
        self.written: list[Vector] = []
        self.silent = False
        self.stale = False
        self.write_error = ""
        self.signal_error = ""
        self.blocked = np.zeros(len(ctx.joints), dtype=bool)
        self.conditions: tuple[Condition, ...] = ()
        self.connect_error = ""
        self.torque = False
        self.relax_outcome: Torque | HardwareError = Torque.OFF
        self._last: JointReading | None = None

    @override
    def read(self) -> JointReading:
        if self.silent:
            raise HardwareError("the bus is silent")
        if self.stale:
            last = self._last or super().read()
            return attrs.evolve(last, stamp_ns=self._ctx.clock.now_ns(), stale=True)
        self._last = super().read()
        return self._last

    @override
    def write(self, position: Vector) -> None:
        if self.write_error:
            raise HardwareError(self.write_error)
        super().write(position)
        self.torque = True
        self.written.append(position.copy())

    @override
    def relax(self) -> Torque:
        if isinstance(self.relax_outcome, HardwareError):
            raise self.relax_outcome
        super().relax()
        self.torque = self.relax_outcome is not Torque.OFF
        return self.relax_outcome

    @override
    def connect(self) -> None:
        if self.connect_error:
            raise HardwareError(self.connect_error)
        super().connect()
        self.torque = True

    @override
    def holding(self) -> Holding | None:
        return Holding(self._ctx.name, f"scripted off {self._ctx.name}") if self.torque else None

    @override
    def health(self) -> tuple[Condition, ...]:
        return self.conditions

    @override
    def read_signal(self, index: int, out: Vector) -> None:
        if self.signal_error:
            raise HardwareError(self.signal_error)
        super().read_signal(index, out)

    @override
    def advance(self, step_ns: int) -> None:
        before = self._position
        super().advance(step_ns)
        self._position = np.where(self.blocked, before, self._position)
        self._velocity = np.where(self.blocked, 0.0, self._velocity)

    @override
    def reset_faults(self) -> None:
        self.silent = self.stale = False


class Rig:
    """A control core with its clock and its hardware."""

    def __init__(self, edits: Mapping[str, Any], *, sim: bool = False, entries: Sequence[Entry] = ()) -> None:
        self.parts: dict[str, ScriptedHardware] = {}
        self.clock = SteppedClock(START_NS)
        document = yaml.safe_load(DOCUMENT) | dict(edits)
        registry = self._registry()
        registry.entries.update({(entry.kind, entry.descriptor.type): entry for entry in entries})
        self.config: RobotConfig = from_document(document, source=Path("mini.yaml"), sim=sim, registry=registry)
        self.core: ControlCore = ControlCore.of(self.config, registry, self.clock, 0)

    def _registry(self) -> Registry:
        def scripted(options: object, ctx: Context) -> ScriptedHardware:
            self.parts[ctx.name] = ScriptedHardware(ctx)
            return self.parts[ctx.name]

        registry = discover([])
        for descriptor in (
            HardwareDescriptor("scripted", scripted, "fails on request"),
            HardwareDescriptor("scene", scripted, "fails as scripted, and can be set up again", simulated=True),
            HardwareDescriptor("stiff", lambda _, ctx: FakeRealHardware(ctx), "cannot relax"),
        ):
            registry.entries["hardware", descriptor.type] = Entry("hardware", descriptor, "fake", "fake", "1.0")
        waypoints = ExecutorDescriptor("waypoints", lambda _, ctx: FakeTrajectoryExecutor(ctx), "straight lines")
        registry.entries["executor", "waypoints"] = Entry("executor", waypoints, "fake", "fake", "1.0")
        return registry

    @property
    def hardware(self) -> ScriptedHardware:
        """The only part."""
        (part,) = self.parts.values()
        return part

    def start(self, mode: str = "stream") -> Rig:
        """Start, and tick once."""
        self.core.start(mode)
        self.tick()
        return self

    def tick(self, count: int = 1) -> ControlState:
        """So many ticks, a period apart."""
        for _ in range(count):
            self.clock.advance(self.core.period_ns)
            state = self.core.tick()
        return state

    def tick_until(self, ready: Callable[[], bool]) -> None:
        """Ticks until something is so, at most a minute of simulated time."""
        for _ in range(6000):
            if ready():
                return
            self.tick()
        raise AssertionError("it does not become so")

    def plan(self, end: list[float], seconds: float = 0.5, joints: tuple[bool, ...] = (True, True, True)) -> None:
        """Send a straight plan from the robot's setpoint to `end` [rad], shape (J,)."""
        assert self.core.state is not None
        rows = round(seconds * 100) + 1
        positions = np.linspace(self.core.state.command, end, rows)
        now_ns = self.clock.now_ns()
        record = PlanRecord(self.core.generation, now_ns, self.core.period_ns, np.array(joints), positions)
        self.core.set_plan(record)

    def call(self, command: Command) -> dict[str, Any]:
        """Have a command carried out; returns the answer."""
        return self.core.handle(command)

    def stop(self, longest: int = 1000) -> int:
        """Stop; returns after how many ticks the robot had stopped."""
        self.core.begin_stop()
        for count in range(longest):
            if self.core.stopped:
                return count
            self.tick()
        raise AssertionError(f"the robot has not stopped after {longest} ticks")

    @property
    def interventions(self) -> int:
        """How often a joint was not given what was asked for."""
        return sum(self.core.counters()["joints"].values())

    def assert_within_limits(self) -> None:
        """All that was written since the start moves within the limits of the joints."""
        written = np.array([self.hardware.written[0], *self.hardware.written])
        steps = np.diff(written, axis=0)
        assert np.abs(steps).max() <= 3.0 * PERIOD_S * (1 + 1e-9)
        assert np.abs(np.diff(steps, axis=0)).max() <= 40.0 * PERIOD_S**2 * (1 + 1e-9)

    def events(self, kind: str) -> list[dict[str, Any]]:
        """Events of a kind so far, each once."""
        found = [dict(event) for event in self.core.events if event["event"] == kind]
        self.core.events.clear()
        return found


@pytest.fixture
def make_rig() -> Callable[..., Rig]:
    return Rig

# mypy: disable-error-code="assignment,unused-ignore"
"""A base whose wheels keep their last velocity, driven by twists through control, in simulated time.

Real are the teleop, the control core, the hardware, the link and what the device process does; the process itself, the
wheels and time are simulated. `Drive` is one such run.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import attrs
import numpy as np
import pytest
import yaml
from ibrobot_lerobot_devices import device, library, link, standing
from ibrobot_lerobot_devices.cmd_vel import CmdVelTeleop
from ibrobot_lerobot_devices.hardware import LeRobotHardware
from ibrobot_lerobot_devices.options import CmdVelOptions, RobotOptions
from ibrobot_testing.contexts import START_NS, host_context

from ibrobot_core.api import (
    HardwareDescriptor,
    JointReading,
    SteppedClock,
    Twist,
    Vector,
    Vector3,
    ns,
)
from ibrobot_core.app import ComponentFailed
from ibrobot_core.config import from_document
from ibrobot_core.control.commands import ClearFaults, EmergencyStop
from ibrobot_core.control.core import ControlCore
from ibrobot_core.interfaces.run_state import PlanRecord
from ibrobot_core.plugins import Entry, Registry, discover

AXES = ("x", "y", "theta")
FEATURES = ("x.vel", "y.vel", "theta.vel")
UNITS = np.array([1.0, 1.0, np.pi / 180])
FASTEST = np.array([0.3, 0.3, 1.5])
DOCUMENT = """
robot:
  name: wheels
  joints:
    - {name: x, lower: -1000, upper: 1000, max_velocity: 0.3, max_acceleration: 2.0}
    - {name: y, lower: -1000, upper: 1000, max_velocity: 0.3, max_acceleration: 2.0}
    - {name: theta, lower: -1000, upper: 1000, max_velocity: 1.5, max_acceleration: 10.0}
  groups: {base: [x, y, theta]}
hardware: {type: wheels}
executors:
  base_position: {type: position, group: base, stale_timeout: 0.25}
control_modes:
  drive: {executors: [base_position]}
default_control_mode: drive
"""
VALUES = {"nan": float("nan"), "inf": float("inf"), "-inf": -float("inf"), "huge": 1e300}
_STEP_NS = ns(0.002)
_IMPORT_S, _CONNECT_S, _READ_S = 2.0, 0.1, 0.002


class Wheels:
    """The motors: they keep their last velocity, whatever happens to who sent it."""

    def __init__(self) -> None:
        self.share = 1.0
        """Of the velocity sent, what they reach."""
        self.sent: Vector = np.zeros(3)
        self.torque = True
        self.at: Vector = np.zeros(3)

    @property
    def velocity(self) -> Vector:
        """[m/s, rad/s], shape (3,)."""
        return self.share * self.sent if self.torque else np.zeros(3)


class FakeBus:
    """The bus of the wheels, as LeRobot's."""

    motors: Mapping[str, Any] = dict.fromkeys(("left_wheel", "back_wheel", "right_wheel"))

    def __init__(self, world: World) -> None:
        self._world = world

    def disable_torque(self, names: list[str]) -> None:
        self._world.fail_if("raises", "unplugged")
        self._world.wheels.torque = False


class FakeBase:
    """A robot as LeRobot's LeKiwi, without its arm."""

    name = "wheels"
    config = None
    is_calibrated = True
    calibration_fpath = Path("wheels.json")
    action_features = observation_features = dict.fromkeys(FEATURES, float)

    def __init__(self, world: World) -> None:
        self._world = world
        self.bus = FakeBus(world)

    def connect(self, calibrate: bool) -> None:
        self._world.fail_if("unplugged")
        self._world.wheels.torque = True

    def get_observation(self) -> dict[str, float]:
        self._world.fail_if("raises", "raises_read", "unplugged")
        found = dict(zip(FEATURES, (self._world.wheels.velocity / UNITS).tolist(), strict=True))
        name = FEATURES[self._world.axis]
        if self._world.fault in VALUES:
            found[name] = VALUES[self._world.fault]
        elif self._world.fault == "missing":
            del found[name]
        return found

    def send_action(self, action: dict[str, float]) -> None:
        self._world.fail_if("raises", "raises_send", "unplugged")
        sent = np.array([action[name] for name in FEATURES]) * UNITS
        assert np.isfinite(sent).all(), f"LeRobot was sent {action}"
        assert (np.abs(sent) <= FASTEST * (1 + 1e-9)).all(), f"LeRobot was sent {action}"
        self._world.wheels.sent = sent

    def stop_base(self) -> None:
        self._world.fail_if("raises", "unplugged")
        self._world.wheels.sent = np.zeros(3)

    def disconnect(self) -> None:
        pass


class FakeChild:
    """In place of `Child`: does what the device process does, at simulated times."""

    world: World  # set by `World`

    def __init__(self, module: str, order: Mapping[str, Any], *, end_s: float) -> None:
        world = self.world
        self.pid = world.count = world.count + 1
        self.alive, self.failure, self.frozen, self.held = True, None, False, False
        self._outbox: list[tuple[int, dict[str, Any]]] = []
        self._inbox: list[dict[str, Any]] = []
        self._device = device.Device(order)
        self.channel = SimpleNamespace(send=self._receive, backlog=0, close=lambda: None)
        self._requests = device.Requests(SimpleNamespace(send=self._send), 1.0)  # type: ignore[arg-type]
        self._waits = bool(order["waits"])
        self._connected = False
        self._busy_ns = world.clock.now_ns() + ns(_IMPORT_S if world.started else 0.0)
        world.children.append(self)

    def _send(self, message: dict[str, Any]) -> None:
        self._outbox.append((self._busy_ns, message))

    def _receive(self, message: dict[str, Any]) -> None:
        self._inbox.append(message)

    def step(self) -> None:
        """What the process does in two milliseconds."""
        now_ns = self.world.clock.now_ns()
        if not self.alive or self.frozen:
            return
        inbox, self._inbox = self._inbox, []
        for request in inbox:
            self._requests.put(request)
        while self.alive and self._busy_ns <= now_ns:
            waits = not self._connected and self._waits
            idle = self._requests._waiting.empty() and not (self._connected and self._device.is_overdue)
            if idle and (waits or self._connected):
                return
            if waits:
                self._requests.next(0.0)
                self._waits, self._busy_ns = False, now_ns + ns(_CONNECT_S)
            elif not self._connected:
                self._connect()
            else:
                self._busy_ns = now_ns + ns(self.world.late_s or _READ_S)
                self.world.late_s = 0.0
                device.serve_next(self._device, self._requests, 0.0)

    def _connect(self) -> None:
        try:
            found = self._device.connect()
        except Exception as error:  # noqa: BLE001 - as the process reports it
            self.failure, self.alive = SimpleNamespace(error=str(error)), False
            return
        self._connected = True
        self._outbox.append((self._busy_ns, {"event": device.READY, "found": found}))

    def wait(self, timeout_s: float) -> dict[str, Any] | None:
        deadline_ns = self.world.clock.now_ns() + ns(timeout_s)
        while True:
            if self._outbox and self._outbox[0][0] <= self.world.clock.now_ns():
                return self._outbox.pop(0)[1]
            if not self.alive:
                raise ComponentFailed(self.failure.error if self.failure else "killed by SIGKILL")
            if self.world.clock.now_ns() >= deadline_ns:
                return None
            self.world.step()

    def receive(self) -> list[dict[str, Any]]:
        return []

    def resume(self) -> None:
        self.frozen = self.frozen and self.held

    def kill(self) -> None:
        self.alive = False

    def end(self) -> bool:
        if self.alive and self._connected and not self.frozen:
            self._device.disconnect()
        self.alive = False
        return False


class World:
    """Time, the wheels and the device processes, with what is wrong with them."""

    def __init__(self) -> None:
        self.clock = SteppedClock(START_NS)
        self.wheels = Wheels()
        self.children: list[FakeChild] = []
        self.count = 100
        self.started = False
        self.fault = ""
        self.axis = 0
        self.late_s = 0.0
        self.later: tuple[int, Callable[[], None]] | None = None
        """When something happens [ns], and what."""

    def fail_if(self, *faults: str) -> None:
        if self.fault in faults:
            raise ConnectionError("the motors do not answer")

    @property
    def child(self) -> FakeChild:
        """The process that has the device."""
        return next(each for each in self.children if each.alive and each._connected)

    def step(self) -> None:
        """Two milliseconds."""
        self.clock.advance(_STEP_NS)
        if self.later is not None and self.clock.now_ns() >= self.later[0]:
            self.later[1]()
            self.later = None
        for child in list(self.children):
            child.step()
        self.wheels.at = self.wheels.at + self.wheels.velocity * _STEP_NS / 1e9

    def patch(self, patches: pytest.MonkeyPatch) -> None:
        """Have the modules of the plugin use this world."""

        def monotonic_ns() -> int:
            return self.clock.now_ns()

        time = SimpleNamespace(monotonic=lambda: monotonic_ns() / 1e9, monotonic_ns=monotonic_ns)
        for module in (device, link, standing):
            patches.setattr(module, "time", time)
        patches.setattr(library, "make", lambda *order: FakeBase(self))
        patches.setattr(library, "choices", lambda *order: {})
        patches.setattr(link, "Child", FakeChild)
        patches.setattr(link, "is_installed", lambda: True)
        patches.setattr(FakeChild, "world", self, raising=False)


@attrs.define
class Stand:
    """How a base came to stand."""

    time_s: float
    """Until it stood for good; inf if it did not."""
    way: float
    """[m], with radians as 0.125 m, the distance of LeKiwi's wheels from its middle."""
    back: float
    """How far it went against its direction."""


class Drive:
    """A run in which a program sends twists.

    Args:
        patches: for time and processes.
        share: of the velocity sent, what the wheels reach.
        registry: the plugins, by default none.
        sections: further sections of the robot YAML.
    """

    def __init__(
        self, patches: pytest.MonkeyPatch, share: float = 1.0, *, registry: Registry | None = None,
        sections: Mapping[str, Any] | None = None,
    ) -> None:  # fmt: skip
        self.world = world = World()
        world.patch(patches)
        world.wheels.share = share
        registry = registry or discover([])

        def make(options: object, ctx: Any) -> LeRobotHardware:
            self.hardware = LeRobotHardware(
                RobotOptions("wheels", units={"x": "metres", "y": "metres", "theta": "degrees"}), ctx
            )
            return self.hardware

        registry.entries["hardware", "wheels"] = Entry(
            "hardware", HardwareDescriptor("wheels", make, "wheels"), "fake", "fake", "1.0"
        )
        document = yaml.safe_load(DOCUMENT) | dict(sections or {})
        config = from_document(document, source=Path("wheels.yaml"), sim=False, registry=registry)
        self.core = ControlCore.of(config, registry, world.clock, 0)
        self.robot = config.robot
        self.ctx = host_context("cmd_vel", robot=config.robot, clock=world.clock)
        self.teleop = CmdVelTeleop(CmdVelOptions(), self.ctx)
        self.teleop.connect()
        self.twist: Vector = np.zeros(3)
        self.twists = True
        """Whether the program sends twists."""
        self.core.start("drive")
        world.started = True
        self.fault_ns: int | None = None
        self.teleop.begin_operation(self._reading())
        self.tick(2.2)  # also for the process that waits

    def _reading(self) -> JointReading:
        newest = self.core._readings.newest
        return attrs.evolve(newest, stamp_ns=self.world.clock.now_ns())

    def tick(self, seconds: float = 0.01, *, starve: bool = False) -> None:
        """Let a time pass [s]; with `starve` control and the host do not run."""
        core, world = self.core, self.world
        for _ in range(round(seconds / 0.01)):
            due_ns = world.clock.now_ns() // core.period_ns * core.period_ns + core.period_ns
            while world.clock.now_ns() < due_ns:
                world.step()
            if starve:
                continue
            self._operate()
            core.tick()
            if core.fault and self.fault_ns is None:
                self.fault_ns = world.clock.now_ns()
                self.teleop.deadman.disarm(self.fault_ns)

    def _operate(self) -> None:
        bus, core, now_ns = self.ctx.bus, self.core, self.world.clock.now_ns()
        assert bus is not None
        if self.twists:
            x, y, theta = self.twist.tolist()
            bus.publish("/cmd_vel", Twist(Vector3(x, y, 0.0), Vector3(0.0, 0.0, theta)))
        measured = self._reading()
        speed = np.minimum(np.abs(measured.velocity), self.robot.max_velocity)  # as a run computes it
        self.teleop.deadman.braking_s = float(np.max(speed / self.robot.max_acceleration)) + 0.01
        positions = self.teleop.operate(measured).positions
        if positions and not core.fault:
            mask, row = np.ones(3, dtype=bool), np.array([[positions[name] for name in AXES]])
            core.set_plan(PlanRecord(core.generation, now_ns, core.period_ns, mask, row))

    def drive(self, twist: Vector, seconds: float) -> None:
        """Press the deadman again, and drive."""
        self.twist = np.zeros(3)
        self.tick(0.02)
        self.twist = twist
        self.tick(seconds)

    def stop(self) -> None:
        """The emergency stop."""
        self.core.handle(EmergencyStop())
        self.fault_ns = self.fault_ns or self.world.clock.now_ns()

    def reset(self, attempts: int = 8) -> bool:
        """Reset as a person does, who tries again; whether the fault is cleared."""
        for _ in range(attempts):
            if "error" not in self.core.handle(ClearFaults()):
                self.fault_ns = None
                self.teleop.begin_operation(self._reading())
                return True
            self.tick(0.2)
        return False

    def stand(self, direction: Vector, seconds: float = 1.0) -> Stand:
        """What the base does from now on [s]."""
        world, begun = self.world, self.world.wheels.at.copy()
        scale = np.array([1.0, 1.0, 0.125])
        begun_ns, last_ns, back = world.clock.now_ns(), world.clock.now_ns(), 0.0
        ways: list[Vector] = []
        step = world.step

        def watch() -> None:
            nonlocal last_ns
            step()
            if world.wheels.velocity.any():
                last_ns = world.clock.now_ns()
            ways.append((world.wheels.at - begun) * scale)

        world.step = watch  # type: ignore[method-assign]
        self.tick(seconds)
        del world.step  # type: ignore[method-assign]
        along = np.array(ways) @ np.sign(direction)
        back = float(np.max(np.maximum.accumulate(along) - along))
        rests = not world.wheels.velocity.any()
        time_s = (last_ns - begun_ns) / 1e9 if rests else np.inf
        return Stand(time_s, float(np.abs(ways[-1]).max()), back)

    def close(self) -> None:
        self.teleop.disconnect()
        self.core.close()


PROCESS = ("killed", "frozen", "held", "thawed", "late")
"""Faults of the process: killed; stopped; stopped so that nothing continues it; stopped for a while; blocked."""
READING = (*VALUES, "missing", "raises_read", "raises_send")
FAULTS = (*PROCESS, *READING)
HOPELESS = ("raises", "unplugged")
"""Faults in which no command reaches the motors."""
DIRECTIONS = [sign * FASTEST * np.eye(3)[axis] for axis in range(3) for sign in (1.0, -1.0)]


def suffer(drive: Drive, fault: str, axis: int, seconds: float) -> Stand | None:
    """Have a fault for a time [s]; returns how the base comes to stand from core's fault on, None without a fault."""
    world = drive.world
    world.axis, child = axis, world.child

    def end() -> None:
        world.fault = ""
        if fault == "thawed":
            child.frozen = False

    if fault in ("frozen", "held", "thawed"):
        child.frozen, child.held = True, fault != "frozen"
    elif fault == "killed":
        child.alive = False
    elif fault == "late":
        world.late_s = seconds
    else:
        world.fault = fault
    begun_ns, direction = world.clock.now_ns(), np.sign(drive.twist)
    world.later = (begun_ns + ns(seconds), end)
    while drive.fault_ns is None and world.clock.now_ns() - begun_ns < ns(seconds):
        drive.tick()
    return None if drive.fault_ns is None else drive.stand(direction, seconds + 2.5)


EVENTS = (*FAULTS, *("stop",) * 4, "starved", "starved", "release", "silence")


@attrs.frozen
class Sequence:
    """What happened to a base that drove."""

    event: str
    stand: Stand
    faulted: bool
    """Whether the event was a fault; else the base was stopped."""
    moved_s: float
    """How long it moved after the reset, without a press [s]."""
    is_reset: bool


def sequence(drive: Drive, random: np.random.Generator, event: str = "") -> Sequence:
    """Drive, suffer an event, reset with the twists going on; everything but a given event is drawn."""
    world, core = drive.world, drive.core
    event = event or str(random.choice(EVENTS))
    world.wheels.share = random.uniform(0.6, 1.0)
    number = int(random.integers(6))
    twist = DIRECTIONS[number] * random.uniform(0.3, 1.0)
    drive.drive(twist, random.uniform(0.3, 1.0))
    assert world.wheels.velocity @ np.sign(twist) > 0, "it does not drive"
    assert not core.fault, core.fault
    stand = None
    if event in (*FAULTS, *HOPELESS):
        stand = suffer(drive, event, number // 2, random.uniform(0.02, 1.0))
    elif event == "starved":
        drive.tick(random.uniform(0.05, 0.2), starve=True)
    elif event == "release":
        drive.twist = np.zeros(3)
        stand = drive.stand(twist)
    elif event == "silence":
        drive.twists = False
        stand = drive.stand(twist)
        drive.twists = True
    faulted = stand is not None and event in (*FAULTS, *HOPELESS)
    if stand is None:  # also after a fault that was over in time
        drive.stop()
        stand = drive.stand(twist)
    drive.stop()
    drive.twist = twist
    is_reset = drive.reset()
    moved_s = drive.stand(twist, 0.6).time_s
    if event in PROCESS:
        drive.tick(2.2)  # another process comes to wait
    return Sequence(event, stand, faulted, moved_s, is_reset)

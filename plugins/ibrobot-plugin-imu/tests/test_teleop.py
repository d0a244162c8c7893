"""A sensor in a hand: bytes in, joint positions out, by the clock of the measurements."""

from __future__ import annotations

import logging
import queue
from collections.abc import Iterator
from typing import Any, override

import numpy as np
import pytest
import serial
from ibrobot_imu.options import ImuOptions
from ibrobot_imu.teleop import ImuTeleop
from ibrobot_kinematics import robot_model
from ibrobot_testing import TeleopSuite, host_context

from ibrobot_core.api import Context, JointReading, Robot, Teleop, TeleopCommand, TeleopError, Vector, ns

from .sensor import Sensor

TICK_S = 0.01
BENT = np.array([0.3, -0.6, 1.1, 0.2, 0.2, 0.4])


class ImuSuite(TeleopSuite):
    model: str

    @pytest.fixture(autouse=True)
    def _sensor(self, robot: Robot) -> Iterator[None]:
        self.robot, self.typed = robot, queue.SimpleQueue[str]()
        with Sensor(self.model) as self.sensor:
            yield

    @override
    def context(self) -> Context:
        self.ctx = host_context(robot=self.robot, keys=lambda: self.typed)
        return self.ctx

    @override
    def make(self, ctx: Context) -> Teleop:
        return ImuTeleop(ImuOptions(self.sensor.port, self.model, timeout=1.0), ctx)

    @override
    def poses(self, ctx: Context) -> list[Vector]:
        return [BENT, BENT / 2]

    @override
    def engage(self, teleop: Teleop) -> None:
        self.sensor.turn()
        for event in ("release:space", "space", "repeat:space"):
            self.typed.put(event)

    @override
    def operate(self, teleop: Teleop) -> None:
        self.sensor.turn(pitch=0.5)
        self.typed.put("repeat:space")

    @override
    def release(self, teleop: Teleop) -> None:
        self.sensor.turn()
        self.typed.put("release:space")


class TestBno08x(ImuSuite):
    model = "bno08x"


class TestWitMotion(ImuSuite):
    model = "witmotion"


class Rig:
    """An operator with a sensor and a key, and a robot that goes where it should."""

    def __init__(self, sensor: Sensor, robot: Robot, model: str = "bno08x", **options: Any) -> None:
        self.sensor, self.robot = sensor, robot
        self.typed = queue.SimpleQueue[str]()
        self.position, self.time_s = BENT.copy(), 1000.0
        self.tilt: dict[str, float] | None = {}
        """What the sensor sends at every tick; None: nothing."""
        self.holds = False
        self.kinematics = robot_model(robot)
        ctx = host_context("imu", robot=robot, keys=lambda: self.typed)
        self.teleop = ImuTeleop(ImuOptions(sensor.port, model, **options), ctx)
        self.teleop.connect()
        self.teleop.begin_operation(self.measured())

    def measured(self) -> JointReading:
        return JointReading(ns(self.time_s), self.position.copy(), np.zeros(6), np.zeros(6))

    def tick(self, sent: bytes = b"") -> TeleopCommand:
        self.time_s += TICK_S
        if self.holds:
            self.typed.put("repeat:space")
        if sent:
            self.sensor.send(sent)
        if self.tilt is not None:
            self.sensor.turn(**self.tilt)
        command = self.teleop.operate(self.measured())
        if command.positions is not None:
            self.position = np.array([command.positions[name] for name in self.robot.joint_names])
        return command

    def run(self, seconds: float, **tilt: float) -> Vector:
        """Tilt for some time; returns how the tool moved [m]."""
        before, self.tilt = self.tool(), tilt
        for _ in range(round(seconds / TICK_S)):
            self.tick()
        return np.asarray(self.tool() - before)

    def press(self) -> None:
        """Hold the key at the present tilt."""
        for event in ("release:space", "space"):
            self.typed.put(event)
        self.tick()
        self.holds = True
        assert self.tick().positions is not None

    def from_bent(self, **tilt: float) -> Vector:
        """How a tilt moves the tool from the bent arm in 0.3 s [m]."""
        self.let_go()
        self.position = BENT.copy()
        self.press()
        return self.run(0.3, **tilt)

    def let_go(self) -> None:
        self.holds = False
        self.run(0.4)

    def tool(self) -> Vector:
        return self.kinematics.forward(self.position).position


@pytest.fixture(params=["bno08x", "witmotion"])
def rig(request: pytest.FixtureRequest, robot: Robot) -> Iterator[Rig]:
    with Sensor(request.param) as sensor:
        rig = Rig(sensor, robot, request.param)
        yield rig
        rig.teleop.disconnect()


@pytest.fixture
def start(robot: Robot) -> Iterator[Any]:
    """Starts rigs with options."""
    with Sensor("bno08x") as sensor:
        rigs: list[Rig] = []

        def start(**options: Any) -> Rig:
            rigs.append(Rig(sensor, robot, **options))
            return rigs[-1]

        yield start
        for rig in rigs:
            rig.teleop.disconnect()


def test_each_tilt_moves_the_tool_along_its_axis(rig: Rig):
    for tilt, way in (({"pitch": 0.7}, [0.03, 0, 0]), ({"roll": 0.7}, [0, -0.03, 0]), ({"yaw": 0.7}, [0, 0, 0.03])):
        np.testing.assert_allclose(rig.from_bent(**tilt), way, atol=0.008)


def test_the_speed_grows_with_the_tilt_beyond_the_dead_zone(start):
    rig = start(dead_zone=0.1, full_tilt=0.5, speed=0.1)
    rest, half, full, more = (rig.from_bent(pitch=tilt)[0] for tilt in (0.09, 0.3, 0.5, 1.2))
    assert rest == pytest.approx(0, abs=1e-9)
    assert half == pytest.approx(full / 2, rel=0.1)
    assert more == pytest.approx(full, rel=0.05)


def test_each_press_makes_the_orientation_the_zero(rig: Rig):
    rig.tilt = {"yaw": 2.0, "pitch": 0.4, "roll": -1.0}
    rig.press()
    assert np.linalg.norm(rig.run(0.5, **rig.tilt)) < 1e-9
    rig.let_go()
    rig.tilt = {"yaw": -3.0}
    rig.press()
    assert np.linalg.norm(rig.run(0.3, yaw=-3.0)) < 1e-9
    # Half a turn is nothing special: from -3.0 to 3.0 rad are 0.28 rad.
    assert 0 > rig.run(0.3, yaw=3.0)[2] > -0.03


def test_axes_can_be_chosen_and_reversed(start):
    rig = start(tool={"x": "-roll", "y": "none", "z": "none", "roll": "pitch"})
    rig.press()
    assert rig.from_bent(roll=0.7)[0] < -0.02
    np.testing.assert_allclose(rig.from_bent(pitch=0.7, yaw=0.7), 0, atol=0.01)
    assert abs(rig.position[4] - BENT[4]) > 0.1


def test_nothing_moves_without_the_key(rig: Rig):
    assert np.linalg.norm(rig.run(1.0, pitch=0.7)) == 0
    rig.typed.put("space")  # one press is no held key
    assert np.linalg.norm(rig.run(0.3, pitch=0.7)) == 0


def test_without_reports_of_releases_a_key_is_held_while_it_repeats(rig: Rig):
    """It repeats after 0.4 s, every 30 ms."""
    rig.tilt = {}
    moves = []
    for i in range(200):
        if i == 0 or (i >= 40 and i % 3 == 1):
            rig.typed.put("space")
        moves.append(rig.tick().positions is not None)
    moves += [rig.tick().positions is not None for _ in range(50)]
    assert np.flatnonzero(moves).tolist() == list(range(40, 220))
    assert "space (known by its repeats)" in rig.teleop.help()


def test_the_gripper_keeps_its_place(rig: Rig):
    rig.press()
    rig.run(0.5, pitch=0.7)
    assert rig.position[5] == BENT[5]


@pytest.mark.parametrize("lost", [None, "garbage"])
def test_without_messages_the_robot_holds_until_the_next_press(rig: Rig, lost: str | None):
    rng = np.random.default_rng(5)
    rig.press()
    rig.run(0.2, pitch=0.7)
    rig.tilt = None
    commands = [rig.tick(rng.bytes(40) if lost else b"") for _ in range(40)]
    holding = [command.positions is None for command in commands]
    assert holding.index(True) <= 11, "a tenth of a second"
    assert all(holding[holding.index(True) :])
    assert np.linalg.norm(rig.run(0.5, pitch=0.7)) == 0, "the key is still held: it counts as released"
    rig.let_go()
    rig.press()
    assert np.linalg.norm(rig.run(0.3, pitch=0.7)) > 0.01


def test_lost_bytes_between_messages_do_not_stop_it(rig: Rig):
    rng = np.random.default_rng(5)
    rig.press()
    rig.tilt = {"pitch": 0.7}
    assert all(rig.tick(rng.bytes(3)).positions is not None for _ in range(50))


def test_silence_is_reported_once(start, caplog: pytest.LogCaptureFixture):
    rig = start()
    rig.tilt = None
    with caplog.at_level(logging.WARNING):
        for _ in range(300):
            rig.tick(b"x" * 10)
    (warning,) = [record.getMessage() for record in caplog.records]
    assert warning.startswith(f"imu: no valid message on {rig.sensor.port} for 1 s, 10")
    assert "check wiring, model and baud_rate" in warning


def test_an_unplugged_sensor_is_an_error_and_comes_back(start, monkeypatch: pytest.MonkeyPatch):
    rig = start()
    rig.press()
    with monkeypatch.context() as patched:

        def gone(port: serial.Serial) -> int:
            raise OSError(5, "Input/output error")

        patched.setattr(serial.Serial, "in_waiting", property(gone))
        with pytest.raises(TeleopError, match=r"imu: lost /dev/pts/\d+: .*Input/output error"):
            rig.tick()
    rig.teleop.disconnect()
    rig.teleop.connect()
    rig.teleop.begin_operation(rig.measured())
    rig.let_go()
    rig.press()
    assert np.linalg.norm(rig.run(0.3, pitch=0.7)) > 0.01


class TestButton:
    """A button at a line of the port."""

    @pytest.fixture(autouse=True)
    def line(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.pressed = False
        for name in ("cts", "dsr"):
            monkeypatch.setattr(serial.Serial, name, property(lambda port: self.pressed))

    @pytest.mark.parametrize("deadman", ["cts", "dsr"])
    def test_moves_while_it_is_pressed(self, start, deadman: str):
        rig = start(deadman=deadman)
        assert np.linalg.norm(rig.run(0.3, pitch=0.7)) == 0
        rig.run(0.05)
        self.pressed = True
        rig.tick()
        assert np.linalg.norm(rig.run(0.3, pitch=0.7)) > 0.01
        self.pressed = False
        assert rig.tick().positions is None

    def test_must_be_released_after_the_mode_begins(self, start):
        self.pressed = True
        rig = start(deadman="cts")
        assert np.linalg.norm(rig.run(0.3, pitch=0.7)) == 0
        self.pressed = False
        rig.tick()
        self.pressed = True
        rig.tick()
        assert rig.tick().positions is not None

    def test_needs_no_terminal(self, robot: Robot):
        with Sensor("bno08x") as sensor:
            teleop = ImuTeleop(ImuOptions(sensor.port, "bno08x", deadman="cts"), host_context(robot=robot))
            teleop.connect()
            teleop.disconnect()


def test_a_port_without_the_line_is_refused(robot: Robot):
    with Sensor("bno08x") as sensor:
        teleop = ImuTeleop(ImuOptions(sensor.port, "bno08x", deadman="cts"), host_context("imu", robot=robot))
        with pytest.raises(TeleopError, match=r"imu: /dev/pts/\d+ has no line cts: "):
            teleop.connect()


def test_the_key_needs_a_terminal(robot: Robot):
    teleop = ImuTeleop(ImuOptions("/dev/nothing", "bno08x"), host_context("imu", robot=robot))
    with pytest.raises(TeleopError, match=r"imu: deadman: key needs a terminal: .* or wire a button to the port"):
        teleop.connect()


def test_a_port_that_is_not_there_is_named(robot: Robot):
    ctx = host_context("imu", robot=robot, keys=queue.SimpleQueue[str])
    with pytest.raises(TeleopError, match=r"imu: /dev/nothing: cannot be opened: .*`ibrobot doctor` checks it"):
        ImuTeleop(ImuOptions("/dev/nothing", "bno08x"), ctx).connect()


def test_help_says_what_to_hold_and_what_moves(start):
    rig = start()
    assert rig.teleop.help() == (
        "bno08x no message yet: hold space (known by its repeats) and tilt (pitch x, -roll y, yaw z)"
    )
    rig.tick()
    assert rig.teleop.help().startswith("bno08x waits: hold space")
    rig.press()
    assert rig.teleop.help().startswith("bno08x moves: hold space")

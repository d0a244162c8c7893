"""A base that LeRobot drives by velocities: its axes as joints, twists for them, and when it stands."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, override

import numpy as np
import pytest
from ibrobot_lerobot_devices import hardware, link
from ibrobot_lerobot_devices.cmd_vel import CmdVelTeleop
from ibrobot_lerobot_devices.hardware import LeRobotHardware
from ibrobot_lerobot_devices.options import CmdVelOptions, RobotOptions
from ibrobot_lerobot_devices.standing import MAY_DRIVE
from ibrobot_testing import TeleopSuite
from ibrobot_testing.contexts import START_NS, SetClock, control_context, host_context

from ibrobot_core.api import (
    Context,
    HardwareError,
    Header,
    Joint,
    JointReading,
    Message,
    Robot,
    SteppedClock,
    Teleop,
    TeleopError,
    Twist,
    TwistStamped,
    Vector3,
    ns,
)

from .conftest import Motors

AXES = ("x", "y", "theta")
ROBOT = Robot(
    "base",
    tuple(
        Joint(name, -1000.0, 1000.0, max_velocity=0.5, max_acceleration=5.0) for name in ("theta", "gripper", "x", "y")
    ),
)
PERIOD_S = 0.01


@pytest.fixture
def ageless(monkeypatch: pytest.MonkeyPatch) -> None:
    """With a stepped clock, the real age of an answer would be one of another clock."""
    monkeypatch.setattr(hardware, "age_ns", lambda answer: 0)


@contextmanager
def connected(motors: Motors, robot: Robot = ROBOT, **changes: Any) -> Iterator[tuple[LeRobotHardware, SteppedClock]]:
    clock = SteppedClock()
    config = {"port": str(motors.port), **changes.pop("config", {})}
    base = LeRobotHardware(
        RobotOptions("fake_base", config, **changes),
        control_context("base", robot=robot, joints=robot.joint_names, clock=clock),
    )
    base.connect()
    try:
        yield base, clock
    finally:
        base.disconnect()


def driven(motors: Motors) -> list[float]:
    """The velocities of the wheels, in LeRobot's units, along x, y and about theta."""
    positions = motors.content["positions"]
    return [positions.get(f"{axis}.vel", 0.0) for axis in AXES]


@pytest.mark.usefixtures("patient", "ageless")
class TestAxes:
    def test_setpoints_drive_the_base_and_its_way_is_measured(self, motors: Motors) -> None:
        with connected(motors) as (base, clock):
            begun = base.read().position
            np.testing.assert_allclose(begun[[0, 2, 3]], 0.0)
            for tick in range(1, 101):  # a second at 0.2 m/s ahead, and at 0.4 rad/s to the right
                setpoint = begun + tick * PERIOD_S * np.array([-0.4, 0.0, 0.2, 0.0])
                base.write(setpoint)
                clock.advance(ns(PERIOD_S))
                reading = base.read()
            np.testing.assert_allclose(reading.position, setpoint, atol=0.01)
            np.testing.assert_allclose(reading.velocity[[0, 2, 3]], [-0.4, 0.2, 0.0], atol=0.03)
            np.testing.assert_allclose(driven(motors), [0.2, 0.0, np.rad2deg(-0.4)], rtol=0.05)
            for _ in range(10):
                base.write(setpoint)  # the end: it brakes and stands, although it is a little away
                clock.advance(ns(PERIOD_S))
                base.read()
            assert driven(motors) == [0.0, 0.0, 0.0]

    def test_a_step_that_no_base_makes_is_a_new_beginning(self, motors: Motors) -> None:
        with connected(motors) as (base, _):
            begun = base.read().position
            base.write(begun + 0.1)
            base.write(begun - 0.001)
            base.read()
            assert driven(motors) == [0.0, 0.0, 0.0]

    def test_a_base_without_another_command_stands(self, motors: Motors) -> None:
        """The control process may hang: the device process needs no word of it."""
        with connected(motors) as (base, _):
            begun = base.read().position
            base.write(begun)
            base.write(begun + np.array([0.0, 0.0, 0.006, 0.0]))
            base.read()
            assert driven(motors)[0] == pytest.approx(0.05)  # as far as the acceleration permits
            while driven(motors)[0]:
                base.read()
            assert driven(motors) == [0.0, 0.0, 0.0]

    def test_a_base_stands_at_the_end(self, motors: Motors, caplog: pytest.LogCaptureFixture) -> None:
        with connected(motors) as (base, _):
            begun = base.read().position
            base.write(begun)
            base.write(begun + np.array([0.0, 0.0, 0.006, 0.0]))
            base.read()
            assert driven(motors)[0] > 0
        assert driven(motors) == [0.0, 0.0, 0.0]
        assert MAY_DRIVE not in caplog.text

    @pytest.mark.parametrize("fails", ["process", "device"])
    def test_an_end_at_which_the_base_may_drive_on_says_so(
        self, motors: Motors, fails: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
    ) -> None:
        monkeypatch.setattr(link, "_FAREWELL_S", 0.1)
        with connected(motors) as (base, _):
            base.read()
            if fails == "process":
                assert base._link.pid is not None
                os.kill(base._link.pid, signal.SIGSTOP)
            else:
                motors.suffer("fail")
        assert f"base: {MAY_DRIVE}" in caplog.text

    def test_an_axis_that_lerobot_does_not_measure_is_named(self, motors: Motors) -> None:
        with (
            pytest.raises(HardwareError, match=r"base: LeRobot does not measure theta.vel, so that nothing says where"),
            connected(motors, config={"measures": False}),
        ):
            pass

    def test_without_joints_for_them_the_axes_stand(self, motors: Motors, caplog: pytest.LogCaptureFixture) -> None:
        alone = Robot("gripper", ROBOT.joints[1:2])
        with connected(motors, alone) as (base, _):
            base.write(base.read().position)
            base.read()
            assert driven(motors) == [0.0, 0.0, 0.0]
        assert "x.vel, y.vel, theta.vel are always 0: the base stands, unless its axes are joints" in caplog.text


AHEAD = Twist(Vector3(0.1, 0.0, 0.0), Vector3(0.0, 0.0, 0.0))


def twist(x: float = 0.0, y: float = 0.0, theta: float = 0.0, **more: float) -> Twist:
    return Twist(Vector3(x, y, more.get("z", 0.0)), Vector3(0.0, 0.0, theta))


def stamped(stamp_ns: int, x: float, frame: str = "") -> TwistStamped:
    return TwistStamped(Header(stamp_ns, frame), twist(x))


class TestCmdVel(TeleopSuite):
    options = CmdVelOptions(x="shoulder_pan", y="shoulder_lift", theta="wrist_roll")
    step_rad = 0.05  # the suite moves faster than a base

    @override
    def context(self) -> Context:
        self.ctx = host_context()
        return self.ctx

    @override
    def make(self, ctx: Context) -> Teleop:
        return CmdVelTeleop(self.options, ctx)

    def _send(self, message: Message) -> None:
        assert self.ctx.bus is not None
        self.ctx.bus.publish(self.options.topic, message)

    @override
    def engage(self, teleop: Teleop) -> None:
        self._send(twist(0.2, theta=0.1))

    @override
    def operate(self, teleop: Teleop) -> None:
        self.engage(teleop)

    @override
    def release(self, teleop: Teleop) -> None:
        self._send(twist())


class Rig:
    """A program that sends twists, and a base that is at every setpoint at once."""

    def __init__(self) -> None:
        self.clock = SetClock(START_NS)
        self.ctx = host_context("wheels", robot=ROBOT, clock=self.clock)
        self.teleop = CmdVelTeleop(CmdVelOptions(), self.ctx)
        self.teleop.connect()
        self.at = np.zeros(4)
        self.velocity = np.zeros(4)
        self.teleop.begin_operation(self._measured())
        for _ in range(60):
            self.tick()

    def _measured(self) -> JointReading:
        return JointReading(self.ctx.clock.now_ns(), self.at.copy(), np.zeros(4), np.zeros(4))

    def tick(self, *messages: Message) -> bool:
        """One period; returns whether the device commanded anything."""
        assert self.ctx.bus is not None
        self.ctx.clock.sleep_until(self.ctx.clock.now_ns() + ns(PERIOD_S))
        for message in messages:
            self.ctx.bus.publish("/cmd_vel", message)
        before = self.at.copy()
        positions = self.teleop.operate(self._measured()).positions
        for name, position in (positions or {}).items():
            self.at[ROBOT.joint_names.index(name)] = position
        self.velocity = (self.at - before) / PERIOD_S
        return positions is not None


class TestTwists:
    def test_a_twist_drives_the_axes_within_their_limits(self) -> None:
        rig = Rig()
        speeds = []
        for _ in range(50):
            assert rig.tick(twist(1.0, 0.0, -0.5))
            speeds.append(rig.velocity.copy())
        np.testing.assert_allclose(speeds[-1], [-0.25, 0.0, 0.5, 0.0], atol=1e-9)  # twice too fast: half of it
        assert np.abs(np.diff(speeds, axis=0)).max() <= 5.0 * PERIOD_S + 1e-9

    def test_without_another_twist_it_stands_within_0_3_s_and_a_stream_that_goes_on_moves_nothing(self) -> None:
        rig = Rig()
        for _ in range(50):
            rig.tick(twist(0.5))
        for _ in range(30):
            rig.tick()
        begun = rig.at.copy()
        for _ in range(100):
            assert not rig.tick(twist(0.5))
        rig.tick(twist())
        np.testing.assert_array_equal(rig.at, begun)
        assert rig.tick(twist(0.5))

    @pytest.mark.parametrize(
        ("message", "why"),
        [
            (twist(float("nan")), "it is not finite"),
            (twist(0.1, z=0.1), "the base has no axis for linear.z"),
            (stamped(0, 0.1, "map"), "its frame is 'map', not 'base_link'"),
        ],
    )
    def test_a_wrong_twist_is_refused_and_named(
        self, message: Message, why: str, caplog: pytest.LogCaptureFixture
    ) -> None:
        rig = Rig()
        for _ in range(10):
            assert not rig.tick(message)
        assert caplog.text.count(f"wheels: refused a twist: {why}") == 1

    @pytest.mark.parametrize("off_s", [0.6, 3.0, 3600.0, -0.6, -3600.0])
    def test_a_twist_of_another_time_is_refused_and_named(self, off_s: float, caplog: pytest.LogCaptureFixture) -> None:
        rig = Rig()
        for _ in range(100):
            assert not rig.tick(stamped(rig.clock.now_ns() + ns(off_s), 0.2))
        assert caplog.text.count("wheels: refused a twist: the time in its header is more than 0.5 s off") == 1
        rig.tick(stamped(0, 0.0))
        assert rig.tick(stamped(rig.clock.now_ns(), 0.2))

    @pytest.mark.parametrize("set_by_s", [3600.0, -3600.0])
    def test_twists_of_now_drive_after_the_computers_clock_is_set(self, set_by_s: float) -> None:
        rig = Rig()
        rig.clock.set_by_ns = ns(set_by_s)
        for now_ns in (rig.clock.now_ns, rig.clock.wall_ns):  # a program of this run's, and one of another computer's
            assert not rig.tick(stamped(now_ns() - ns(3.0), 0.2))
            rig.tick(stamped(0, 0.0))
            for _ in range(30):
                assert rig.tick(stamped(now_ns(), 0.2))
            for _ in range(60):
                rig.tick()

    def test_a_robot_without_its_joints_is_named(self) -> None:
        with pytest.raises(TeleopError, match="none of the joints x, y, theta: give those of its base"):
            CmdVelTeleop(CmdVelOptions(), host_context()).connect()

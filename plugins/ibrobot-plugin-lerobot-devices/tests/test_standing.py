"""A base stands at faults of its device and at STOP: with device processes, and by sequences in simulated time."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator

import numpy as np
import pytest
from ibrobot_lerobot_devices import link, standing
from ibrobot_lerobot_devices.base import Base
from ibrobot_lerobot_devices.hardware import LeRobotHardware
from ibrobot_lerobot_devices.units import METRES, Mapped, Scale

from ibrobot_core.api import HardwareError, Severity, ns

from .conftest import PATIENCE_S, Motors
from .driving import DIRECTIONS, FAULTS, FEATURES, HOPELESS, READING, Drive, sequence
from .test_base import ageless, connected, driven

__all__ = ["ageless"]
STILL = [0.0, 0.0, 0.0]
AHEAD = np.array([0.0, 0.0, 0.002, 0.0])
"""A step of the setpoint: 0.2 m/s ahead."""


def drive(base: LeRobotHardware, motors: Motors) -> np.ndarray:
    """Drive ahead; returns the last setpoint."""
    setpoint = base.read().position
    base.write(setpoint)
    for _ in range(10):
        setpoint = setpoint + AHEAD
        base.write(setpoint)
        base.read()
    assert driven(motors)[0] > 0.05
    return np.asarray(setpoint)


def goes_on(base: LeRobotHardware, setpoint: np.ndarray) -> str:
    """A tick of control, which reads and writes whatever happens; returns the fault."""
    fault = ""
    for call in (base.read, lambda: base.write(setpoint)):
        try:
            call()
        except HardwareError as error:
            fault = fault or str(error)
    return fault


def until_it_stands(base: LeRobotHardware, motors: Motors, setpoint: np.ndarray) -> str:
    """Control goes on until the wheels stand; returns the first fault."""
    deadline_s, first = time.monotonic() + PATIENCE_S, ""
    while driven(motors) != STILL or not first:
        fault = goes_on(base, setpoint)
        first = first or fault
        assert time.monotonic() < deadline_s, f"it drives on: {driven(motors)}, {first}"
        time.sleep(0.005)
    return first


def reset(base: LeRobotHardware) -> None:
    """As an operator does, who resets again while LeRobot starts."""
    for _ in range(20):
        try:
            base.reset_faults()
        except HardwareError:
            continue
        return
    base.reset_faults()


@pytest.fixture
def quick_to_give_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """Only the order of what is tried counts here."""
    monkeypatch.setattr(standing, "_PATIENCE_S", 0.5)


@pytest.mark.usefixtures("patient", "ageless")
class TestProcess:
    @pytest.mark.parametrize(
        ("fault", "text"),
        [
            ("nan", "LeRobot measures x.vel as nan"),
            ("inf", "LeRobot measures x.vel as inf"),
            ("huge", "LeRobot measures x.vel as 1e+300, which the base cannot reach"),
            ("missing", "LeRobot's reading has no x.vel"),
            ("fail_read", "the base does not answer"),
            ("fail_send", "LeRobot does not carry actions out: ConnectionError: the base does not answer"),
        ],
    )
    def test_a_device_that_fails_has_its_base_stand_and_a_reset_ends_it(
        self, motors: Motors, fault: str, text: str
    ) -> None:
        with connected(motors) as (base, _):
            setpoint = drive(base, motors)
            motors.suffer(fault)
            assert text in until_it_stands(base, motors, setpoint)
            assert "the base may still be driving: switch it off" in goes_on(base, setpoint)
            motors.suffer("")
            reset(base)
            position = base.read().position
            assert np.isfinite(position).all()
            base.write(position)
            base.read()
            assert driven(motors) == STILL

    def test_a_process_that_dies_is_replaced_by_one_that_stops_the_base(self, motors: Motors) -> None:
        with connected(motors) as (base, _):
            setpoint = drive(base, motors)
            pid = base._link.pid
            assert pid is not None
            os.kill(pid, signal.SIGKILL)
            assert "killed by SIGKILL" in until_it_stands(base, motors, setpoint)
            reset(base)
            assert not base.read().stale
            assert base._link.pid != pid

    @pytest.mark.usefixtures("quick_to_give_up")
    def test_a_process_that_is_stopped_goes_on_and_has_the_base_stand(self, motors: Motors) -> None:
        with connected(motors, blocked=0.2) as (base, _):
            setpoint = drive(base, motors)
            pid = base._link.pid
            assert pid is not None
            os.kill(pid, signal.SIGSTOP)
            base._wait_s = 0.004
            assert "get_observation does not return" in until_it_stands(base, motors, setpoint)

    def test_a_thawed_process_does_not_carry_old_actions_out(self, motors: Motors) -> None:
        with connected(motors, blocked=0.2) as (base, _):
            setpoint = drive(base, motors)
            pid = base._link.pid
            assert pid is not None
            os.kill(pid, signal.SIGSTOP)
            for _ in range(10):
                base.write(setpoint := setpoint + AHEAD)
            time.sleep(0.3)  # more than the age at which an action is too old
            os.kill(pid, signal.SIGCONT)
            base.read()
            assert driven(motors) == STILL


class TestInDoubt:
    @pytest.mark.parametrize("fault", HOPELESS)
    def test_where_nothing_stops_the_base_the_fault_says_so(
        self, fault: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
    ) -> None:
        run = Drive(monkeypatch)
        try:
            run.drive(DIRECTIONS[0], 0.5)
            run.world.fault = fault
            run.tick(1.0)
            assert run.world.wheels.velocity.any()
            assert "the base may still be driving: switch it off" in run.core.fault
            assert "the base may still be driving: switch it off" in caplog.text
            (condition,) = run.hardware.health()
            assert condition.severity is Severity.FAULT
            assert not run.reset(1)
            run.world.fault = ""
            run.tick(3.0)
            assert not run.world.wheels.velocity.any()
            assert "the base stands: LeRobot has stopped it" in caplog.text
            assert run.hardware.health() == ()
            assert run.reset()
        finally:
            run.close()


@pytest.fixture(scope="class")
def run() -> Iterator[Drive]:
    with pytest.MonkeyPatch.context() as patches:
        found = Drive(patches)
        yield found
        found.close()


class TestDrives:
    """Each event three times, in random sequences."""

    @pytest.mark.parametrize("event", [*FAULTS, "stop", "starved", "release", "silence"])
    def test_a_base_stands_in_time_and_moves_only_by_a_press(self, run: Drive, event: str) -> None:
        random = np.random.default_rng(sum(event.encode()))
        for _ in range(3):
            each = sequence(run, random, event)
            assert each.stand.time_s <= (0.5 if each.faulted else 0.3), each
            assert each.stand.back <= 0.001, each
            assert each.moved_s == 0.0, each
            if event in READING and event != "raises_send" and each.faulted:
                assert each.stand.time_s == 0.0, "it is sent velocities after the fault"
            assert each.is_reset, each

    @pytest.mark.parametrize("direction", DIRECTIONS, ids=[f"{sign}{name}" for name in FEATURES for sign in "+-"])
    def test_stop_brakes_to_rest_within_the_limits_and_stays(self, run: Drive, direction: np.ndarray) -> None:
        run.world.wheels.share = 0.6
        run.drive(direction, 1.0)
        speeds = [np.abs(run.world.wheels.velocity).max()]
        run.stop()
        for _ in range(40):
            run.tick()
            speeds.append(np.abs(run.world.wheels.velocity).max())
        steps = np.diff(speeds)
        fastest = np.abs(direction).max()
        assert (steps <= 1e-9).all()
        assert (-steps <= 1.01 * fastest / 15).all()  # the limits: from full speed in 15 ticks
        assert speeds[17:] == [0.0] * 24
        assert run.reset()

    def test_an_old_action_lets_the_base_stand(self, run: Drive) -> None:
        world = run.world
        ahead = {"x.vel": 0.1, "y.vel": 0.0, "theta.vel": 0.0}
        for age_s, sent in ((0.2, 0.1), (0.3, 0.0)):
            world.child._device.act(ahead, world.clock.now_ns() - ns(age_s))
            assert world.wheels.sent[0] == sent
        run.tick(0.1)


def test_a_setpoint_that_comes_to_where_the_base_stands_does_not_move_it() -> None:
    """A mode or a press begins with the command where the base is, which may be behind the setpoint that was held."""
    axes = [Mapped("x", "x", METRES, Scale(1.0))]
    base = Base(axes, {"x": "x.vel"}, ["x.vel"], np.array([0.3]), np.array([2.0]), 0.01)
    for ahead in (0.1, -0.1):
        steps = [0.0, 0.0002, 0.0006, *[0.0012] * 5]
        way = ahead - np.sign(ahead) * np.cumsum(steps + [0.001] * 80 + steps[::-1])
        for setpoint in way[np.abs(way) <= 0.1]:
            assert base.drive(np.array([setpoint])) == {"x.vel": 0.0}
    moved = [base.drive(np.array([at]))["x.vel"] for at in np.arange(0.0, 0.02, 0.001)]
    assert moved[0] == 0.0
    assert moved[-1] > 0.05


def test_limits() -> None:
    assert standing._PATIENCE_S + link._TRAFFIC_S < standing._HOPE_S

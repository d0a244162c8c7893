"""Several components of hardware as one robot."""

from __future__ import annotations

import threading
from typing import override

import numpy as np
import pytest
from ibrobot_testing.contexts import make_robot

from ibrobot_core.api import EpisodeSetup
from ibrobot_core.control.hardware_group import HardwareGroup
from ibrobot_core.errors import HardwareError, NotSupported
from ibrobot_core.interfaces.hardware import Hardware, JointReading, Signal, Torque, nan_vector
from ibrobot_core.robot import Vector

ROBOT = make_robot()
LEFT = ("gripper", "shoulder_pan", "elbow_flex")
RIGHT = ("wrist_roll", "shoulder_lift", "wrist_flex")


class Part(Hardware):
    """Measures the place of each joint in the robot's order, and keeps what was written to it."""

    signals = (Signal("/part", 2),)

    def __init__(self, joints: tuple[str, ...], stamp_ns: int = 100) -> None:
        self.joints = joints
        self.stamp_ns = stamp_ns
        self.order = ROBOT.indices(joints).astype(np.float64)
        self.connected = False
        self.error: Exception | None = None
        self.written: Vector | None = None
        self.gate = threading.Event()
        self.gate.set()
        self.stale = False

    @override
    def connect(self) -> None:
        self._act()
        self.connected = True

    @override
    def read(self) -> JointReading:
        self._act()
        return JointReading(self.stamp_ns, self.order, self.order + 10, nan_vector(len(self.joints)), self.stale)

    @override
    def write(self, position: Vector) -> None:
        self._act()
        self.written = position.copy()

    @override
    def disconnect(self) -> None:
        self.connected = False

    @override
    def read_signal(self, index: int, out: Vector) -> None:
        out[:] = self.order[:2]

    def _act(self) -> None:
        assert self.gate.wait(60.0)
        if self.error is not None:
            raise self.error


@pytest.fixture
def two():
    left, right = Part(LEFT, 100), Part(RIGHT, 90)
    parts = HardwareGroup(ROBOT, {"left": left, "right": right})
    yield parts, left, right
    parts.disconnect()


def test_joints_come_in_robot_order(two) -> None:
    reading = two[0].read()

    np.testing.assert_array_equal(reading.position, np.arange(6.0))
    np.testing.assert_array_equal(reading.velocity, np.arange(6.0) + 10)
    assert np.isnan(reading.effort).all()
    assert reading.stamp_ns == 90
    assert not reading.stale


def test_one_stale_part_makes_a_stale_reading(two) -> None:
    two[2].stale = True
    assert two[0].read().stale


def test_each_part_receives_its_own_joints_in_its_own_order(two) -> None:
    parts, left, right = two
    parts.write(np.arange(6.0))

    np.testing.assert_array_equal(left.written, left.order)
    np.testing.assert_array_equal(right.written, right.order)


def test_one_part_in_another_order_is_permuted() -> None:
    part = Part(tuple(reversed(ROBOT.joint_names)))
    parts = HardwareGroup(ROBOT, {"arm": part})
    parts.write(np.arange(6.0))

    np.testing.assert_array_equal(parts.read().position, np.arange(6.0))
    np.testing.assert_array_equal(part.written, np.arange(6.0)[::-1])


def test_signals_follow_one_another_in_the_order_of_the_parts(two) -> None:
    parts, left, right = two

    np.testing.assert_array_equal(parts.read_signals(), [*left.order[:2], *right.order[:2]])
    assert [signal.size for signal in parts.signals] == [2, 2]


@pytest.mark.parametrize("act", [lambda p: p.read(), lambda p: p.write(np.zeros(6))], ids=["read", "write"])
def test_the_part_that_fails_is_named(two, act) -> None:
    two[2].error = HardwareError("servo 3 does not answer")

    with pytest.raises(HardwareError, match=r"^right: servo 3 does not answer$"):
        act(two[0])


def test_a_part_that_names_itself_is_not_named_twice(two) -> None:
    two[1].error = HardwareError("left: no such port")

    with pytest.raises(HardwareError, match=r"^left: no such port$"):
        two[0].connect()


def test_where_one_does_not_connect_the_others_are_released(two) -> None:
    parts, left, right = two
    right.error = HardwareError("no such port")

    with pytest.raises(HardwareError, match="right: no such port"):
        parts.connect()
    assert not left.connected


def test_a_failing_part_does_not_leave_another_at_work(two) -> None:
    parts, left, right = two
    left.error = HardwareError("unplugged")
    right.gate.clear()
    failures: list[Exception] = []

    def read() -> None:
        with pytest.raises(HardwareError) as message:
            parts.read()
        failures.append(message.value)

    reading = threading.Thread(target=read)
    reading.start()
    reading.join(0.05)
    assert reading.is_alive()  # the right part still reads

    right.gate.set()
    reading.join()
    assert [str(failure) for failure in failures] == ["left: unplugged"]


def test_what_cannot_relax_is_named(two) -> None:
    with pytest.raises(NotSupported, match="'left' cannot take torque off"):
        two[0].require_relax()


def test_only_a_simulation_is_set_up_again(two) -> None:
    with pytest.raises(NotSupported, match="only a simulation"):
        two[0].reset_episode(EpisodeSetup(1))
    assert two[0].success() is None


class Relaxing(Part):
    @override
    def relax(self) -> Torque:
        self._act()
        return Torque.OFF


class TestHanging:
    """A part that does not return: its neighbours are read and written all the same."""

    @pytest.fixture
    def hung(self):
        left, right = Relaxing(LEFT, 100), Relaxing(RIGHT, 90)
        parts = HardwareGroup(ROBOT, {"left": left, "right": right}, timeout_s=0.05)
        parts.write(np.arange(6.0))
        right.gate.clear()
        yield parts, left, right
        right.gate.set()
        parts.disconnect()

    def test_a_write_that_hangs_is_named_and_the_others_are_written(self, hung):
        parts, left, _ = hung
        for _ in range(3):
            with pytest.raises(HardwareError, match=r"^right: "):
                parts.write(np.arange(6.0) + 1)

        np.testing.assert_array_equal(left.written, left.order + 1)

    def test_a_read_that_hangs_is_named(self, hung):
        with pytest.raises(HardwareError, match=r"^right: hangs: it has not returned in time$"):
            hung[0].read()
        with pytest.raises(HardwareError, match=r"^right: still does not return from an earlier call$"):
            hung[0].read()

    def test_the_others_relax(self, hung):
        with pytest.raises(HardwareError):
            hung[0].read()
        outcomes = hung[0].relax()

        assert outcomes["left"] is Torque.OFF
        assert "still does not return" in str(outcomes["right"])

    def test_its_signals_are_missing_and_it_has_no_counters_or_conditions(self, hung):
        parts, left, right = hung
        with pytest.raises(HardwareError):
            parts.read()
        right.counters = right.health = lambda: pytest.fail("it would hang")

        np.testing.assert_array_equal(parts.read_signals(), [*left.order[:2], np.nan, np.nan])
        assert parts.counters() == {}
        assert parts.health() == []

    def test_once_it_returns_it_is_used_again(self, hung):
        parts, _, right = hung
        with pytest.raises(HardwareError):
            parts.write(np.arange(6.0))
        late = parts._threads["right"]._late
        right.gate.set()
        late.result(60.0)
        parts.write(np.arange(6.0) + 2)

        np.testing.assert_array_equal(right.written, right.order + 2)

    def test_it_does_not_keep_the_others_from_being_released(self, hung, caplog):
        parts, left, right = hung
        left.connected = right.connected = True
        with pytest.raises(HardwareError):
            parts.read()
        parts.disconnect()

        assert (left.connected, right.connected) == (False, True)
        assert "right hangs, and is not released" in caplog.text

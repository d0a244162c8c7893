"""The teleop: conformance, its deadman, and requests of pages that make no sense."""

from __future__ import annotations

import itertools
from typing import Any, override

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ibrobot_testing import TeleopSuite, check_descriptor, host_context
from ibrobot_web import ibrobot_teleop
from ibrobot_web.options import WebTeleopOptions
from ibrobot_web.teleop import JOG, Jog, WebTeleop

from ibrobot_core.api import Context, JointReading, Teleop, TeleopError, ns

PRESSES = itertools.count(1)


class TestConformance(TeleopSuite):
    @override
    def make(self, ctx: Context) -> WebTeleop:
        return WebTeleop(WebTeleopOptions(), ctx)

    @override
    def engage(self, teleop: Teleop) -> None:
        assert isinstance(teleop, WebTeleop)
        teleop.take(Jog(press=next(PRESSES)))

    @override
    def operate(self, teleop: Teleop) -> None:
        assert isinstance(teleop, WebTeleop)
        teleop.take(Jog({"shoulder_pan": 1.0}, press=next(PRESSES)))

    @override
    def release(self, teleop: Teleop) -> None:
        assert isinstance(teleop, WebTeleop)
        teleop.take(None)


class Rig:
    """A connected teleop, whose robot is where it was commanded to be."""

    def __init__(self, **options: Any) -> None:
        self.ctx = host_context("web")
        self.teleop = WebTeleop(WebTeleopOptions(**options), self.ctx)
        self.teleop.connect()
        self.position = np.full(6, 0.1)
        self.teleop.activate(self.measured())

    def measured(self) -> JointReading:
        return JointReading(self.ctx.clock.now_ns(), self.position.copy(), np.zeros(6), np.zeros(6))

    def tick(self, seconds: float = 0.01) -> bool:
        """Advance the time and follow the command; return whether there was one."""
        self.ctx.clock.sleep_until(self.ctx.clock.now_ns() + ns(seconds))
        positions = self.teleop.read(self.measured()).positions
        if positions is None:
            return False
        self.position = np.array([positions[joint] for joint in self.ctx.robot.joint_names])
        return True

    def jog(self, seconds: float, **request: Any) -> None:
        press = next(PRESSES)
        for _ in range(round(seconds / 0.01)):
            self.teleop.take(Jog(press=press, **request))
            self.tick()


def test_descriptor() -> None:
    (descriptor,) = ibrobot_teleop()
    check_descriptor(descriptor, WebTeleopOptions())


def test_the_deadman_is_released_when_messages_stay_away() -> None:
    rig = Rig()
    rig.jog(0.5, joints={"shoulder_pan": 1.0})
    ticks = 0
    while rig.tick():
        ticks += 1
    assert ticks <= 20
    before = rig.position.copy()
    assert not any(rig.tick() for _ in range(50))
    np.testing.assert_array_equal(rig.position, before)


def test_a_joint_moves_at_the_speed_of_the_options() -> None:
    rig = Rig(joint_speed=0.4)
    rig.jog(1.01, joints={"elbow_flex": -0.5})
    assert rig.position[2] - 0.1 == pytest.approx(-0.2, abs=0.005)
    assert (np.delete(rig.position, 2) == 0.1).all()


def test_a_target_is_approached_and_not_passed() -> None:
    rig = Rig(joint_speed=1.0)
    rig.jog(0.2, targets={"wrist_flex": 0.5})
    assert 0.2 < rig.position[3] < 0.35
    rig.jog(1.0, targets={"wrist_flex": 0.5})
    assert rig.position[3] == pytest.approx(0.5)


def test_a_pose_is_approached() -> None:
    rig = Rig(joint_speed=1.0)
    rig.jog(3.0, pose="rest")
    np.testing.assert_allclose(rig.position, rig.ctx.robot.pose("rest"), atol=1e-6)


def test_a_press_from_before_a_reset_moves_nothing() -> None:
    rig = Rig()
    press = next(PRESSES)
    rig.teleop.take(Jog({"shoulder_pan": 1.0}, press=press))
    assert rig.tick()
    rig.teleop.activate(rig.measured())
    rig.teleop.take(Jog({"shoulder_pan": 1.0}, press=press))
    assert not rig.tick()
    rig.teleop.take(Jog({"shoulder_pan": 1.0}, press=next(PRESSES)))
    assert rig.tick()


def test_requests_that_fit_no_robot_are_refused() -> None:
    rig = Rig()
    assert rig.ctx.bus is not None
    for request, why in (
        (Jog({"shoulder": 1.0}), "no joint 'shoulder'; the joints are: shoulder_pan"),
        (Jog(pose="hom"), "no pose 'hom'; the poses are: home, rest"),
        (Jog(linear=np.ones(3)), "moving the tool needs robot.description.mjcf"),
    ):
        with pytest.raises(TeleopError, match=why):
            rig.ctx.bus.call(JOG, request)
    assert not rig.tick()


JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
)


@given(st.dictionaries(st.sampled_from(["joints", "targets", "linear", "turn", "pose", "press"]), JSON))
def test_any_message_is_a_request_or_a_clear_error(message: dict[str, Any]) -> None:
    try:
        request = Jog.read(message)
    except ValueError:
        return
    assert all(np.isfinite([*request.joints.values(), *request.targets.values(), *request.linear, *request.turn]))
    assert all(abs(speed) <= 1 for speed in (*request.joints.values(), *request.linear, *request.turn))

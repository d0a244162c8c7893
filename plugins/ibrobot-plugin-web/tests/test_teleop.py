"""The teleop: conformance, its deadman, and requests of pages that make no sense."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, override

import attrs
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ibrobot_testing import TeleopSuite, check_descriptor, host_context
from ibrobot_web import ibrobot_teleop
from ibrobot_web.options import WebTeleopOptions
from ibrobot_web.teleop import JOG, RELEASE, Jog, Released, WebTeleop

from ibrobot_core.api import Context, JointReading, Teleop, TeleopError, ns


def press(teleop: WebTeleop, **motion: Any) -> Jog:
    """A new press of the page's deadman."""
    clock = teleop._ctx.clock
    clock.sleep_until(clock.now_ns() + 1)
    return Jog(clock.now_ns(), clock.now_ns(), **motion)


class TestConformance(TeleopSuite):
    @override
    def make(self, ctx: Context) -> WebTeleop:
        return WebTeleop(WebTeleopOptions(), ctx)

    @override
    def engage(self, teleop: Teleop) -> None:
        assert isinstance(teleop, WebTeleop)
        self.pressed = press(teleop)
        teleop.take(self.pressed)

    @override
    def hold(self, teleop: Teleop) -> None:
        assert isinstance(teleop, WebTeleop)
        now = press(teleop, joints={"shoulder_pan": 1.0})
        teleop.take(attrs.evolve(now, began_ns=self.pressed.began_ns))

    @override
    def operate(self, teleop: Teleop) -> None:
        assert isinstance(teleop, WebTeleop)
        teleop.take(press(teleop, joints={"shoulder_pan": 1.0}))

    @override
    def release(self, teleop: Teleop) -> None:
        assert isinstance(teleop, WebTeleop)
        teleop.take(Released())


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

    def press(self) -> int:
        """Press the deadman; return when [ns]."""
        self.ctx.clock.sleep_until(self.ctx.clock.now_ns() + ns(0.001))
        return self.ctx.clock.now_ns()

    def hold(self, began_ns: int, age_s: float = 0.0, **motion: Any) -> bool:
        """Say that the deadman is held, and go on by a tick; return whether the robot moves."""
        self.teleop.take(Jog(self.ctx.clock.now_ns() - ns(age_s), began_ns, **(motion or {"joints": {"gripper": 1.0}})))
        return self.tick()

    def jog(self, seconds: float, **motion: Any) -> None:
        began_ns = self.press()
        for _ in range(round(seconds / 0.01)):
            self.hold(began_ns, **motion)


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


def silence(rig: Rig, began_ns: int) -> None:
    for _ in range(40):
        rig.tick()


def late(rig: Rig, began_ns: int) -> None:
    for _ in range(40):
        rig.hold(began_ns, age_s=0.4)


def host_paused(rig: Rig, began_ns: int) -> None:
    rig.tick(2.0)


def reset(rig: Rig, began_ns: int) -> None:
    rig.teleop.activate(rig.measured())


def replaced(rig: Rig, began_ns: int) -> None:
    rig.teleop.disconnect()
    rig.teleop.connect()
    rig.teleop.activate(rig.measured())


def lost_control(rig: Rig, began_ns: int) -> None:
    rig.teleop.take(Released())


def released(rig: Rig, began_ns: int) -> None:
    rig.teleop.take(Released(rig.ctx.clock.now_ns()))


EVENTS = (silence, late, host_paused, reset, replaced, lost_control, released)


@pytest.mark.parametrize("event", EVENTS, ids=lambda event: str(event.__name__))
def test_after_any_event_only_a_press_that_began_later_moves(event: Callable[[Rig, int], None]) -> None:
    rig = Rig()
    old = rig.press()
    assert rig.hold(old)
    event(rig, old)
    assert not any(rig.hold(old) for _ in range(100)), "the same press, held all the time"
    for _ in range(20):
        rig.tick()
    new = rig.press()
    assert rig.hold(new)
    rig.hold(old)
    assert rig.hold(new)


def test_a_press_that_the_page_made_before_a_reset_and_sent_after_it_moves_nothing() -> None:
    rig = Rig()
    began_ns = rig.press()
    rig.tick()
    rig.teleop.activate(rig.measured())
    assert not rig.hold(began_ns)


def test_motion_ends_soon_after_the_last_message_was_made_however_late_it_arrives() -> None:
    rig = Rig()
    began_ns = rig.press()
    rig.tick(0.06)
    ticks = 0
    for _ in range(10):
        assert rig.hold(began_ns, age_s=0.05)
    while rig.tick():
        ticks += 1
    assert ticks <= 15


def test_requests_of_a_page_that_another_one_replaced_do_not_renew_its_press() -> None:
    rig = Rig()
    first = rig.press()
    assert rig.hold(first)
    rig.teleop.take(Released())
    second = rig.press()
    assert rig.hold(second)
    rig.teleop.take(Released())
    assert not rig.hold(first)
    assert not rig.hold(second)


def test_requests_that_fit_no_robot_are_refused() -> None:
    rig = Rig()
    assert rig.ctx.bus is not None
    for request, why in (
        (Jog(1, 1, joints={"shoulder": 1.0}), "no joint 'shoulder'; the joints are: shoulder_pan"),
        (Jog(1, 1, pose="hom"), "no pose 'hom'; the poses are: home, rest"),
        (Jog(1, 1, linear=(1.0, 1.0, 1.0)), "moving the tool needs robot.description.mjcf"),
    ):
        with pytest.raises(TeleopError, match=why):
            rig.ctx.bus.call(JOG, request)
    assert not rig.tick()


@given(st.lists(st.integers(-100_000, 100_000), min_size=30, max_size=30))
def test_a_press_whose_begin_is_known_to_a_tenth_of_a_millisecond_stays_one(errors_ns: list[int]) -> None:
    rig = Rig()
    began_ns = rig.press()
    assert rig.hold(began_ns)
    assert all(rig.hold(began_ns + error_ns) for error_ns in errors_ns)


def test_the_devices_of_a_mode_share_the_services() -> None:
    context = host_context()
    names = ("left", "right")
    robots = {
        name: attrs.evolve(context.robot, joints=context.robot.joints[part])
        for name, part in zip(names, (slice(0, 3), slice(3, 6)), strict=True)
    }
    devices = {
        name: WebTeleop(WebTeleopOptions(), attrs.evolve(context, name=name, robot=robot))
        for name, robot in robots.items()
    }
    bus = context.bus
    assert bus is not None
    for device in devices.values():
        device.connect()

    def press(device: str, joint: str) -> list[str]:
        context.clock.sleep_until(context.clock.now_ns() + ns(0.001))
        now_ns = context.clock.now_ns()
        bus.call(JOG, Jog(now_ns, now_ns, joints={joint: 1.0}, device=device))
        zeros = np.zeros(3)
        reading = JointReading(now_ns, zeros, zeros, zeros)
        return [name for name, each in devices.items() if each.read(reading).positions is not None]

    joints = {name: robot.joint_names[0] for name, robot in robots.items()}
    assert press("left", joints["left"]) == ["left"]
    assert press("right", joints["right"]) == ["left", "right"], "both arms move at once"
    bus.call(RELEASE, Released())
    assert press("right", joints["right"]) == ["right"], "a release is one for all"
    with pytest.raises(TeleopError, match="device '' does not jog in this mode; those that do are: left, right"):
        press("", joints["left"])
    devices.pop("left").disconnect()
    assert press("", joints["right"]) == ["right"], "the only one need not be named"
    devices["right"].disconnect()
    assert not bus.serves(JOG)

"""Contexts for tests: a small robot of six joints, a stepped clock, a bus and a logger."""

from __future__ import annotations

import logging
from typing import Any, override

from ibrobot_core.api import NS_PER_S, Clock, Context, Description, Joint, Robot, SteppedClock
from ibrobot_core.app import Bus

START_NS = 1_700_000_000 * NS_PER_S
"""Initial time of a test's stepped clock [ns]: a plausible date, so that stamps near zero are conspicuous."""

ARM = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
GRIPPER = ("gripper",)


class SetClock(SteppedClock):
    """A stepped clock of a computer whose time of day was set, e.g. by NTP.

    Attributes:
        set_by_ns: how far the time of day was set forward [ns].
    """

    set_by_ns = 0

    @override
    def wall_ns(self) -> int:
        return self.now_ns() + self.set_by_ns


def make_robot() -> Robot:
    """A robot with six joints in the groups `arm` and `gripper`; all limits are different and asymmetric."""
    limits = ((-1.9, 1.8), (-1.7, 1.6), (-1.6, 1.7), (-1.5, 1.65), (-2.7, 2.8), (-0.2, 1.7))
    joints = tuple(
        Joint(name, lower, upper, max_velocity=2.0 + 0.25 * i, max_acceleration=10.0 + i)
        for i, (name, (lower, upper)) in enumerate(zip(ARM + GRIPPER, limits, strict=True))
    )
    poses = {"home": (0.0,) * 6, "rest": (0.0, -1.5, 1.5, 0.75, 0.0, 0.0)}
    return Robot(
        name="tester",
        joints=joints,
        robot_type="tester",
        groups={"arm": ARM, "gripper": GRIPPER},
        description=Description(poses=poses),
    )


def control_context(name: str = "subject", *, joints: tuple[str, ...] | None = None, **changes: Any) -> Context:
    """A context as in the control process: it owns `joints` (all of the robot's when None) and has no bus.

    Args:
        name: the component's name.
        joints: names of the joints that it owns.
        changes: any other field of `Context`.
    """
    robot = changes.pop("robot", None) or make_robot()
    clock: Clock = changes.pop("clock", None) or SteppedClock(START_NS)
    log = logging.getLogger(f"ibrobot.test.{name}")
    return Context(name, clock, log, robot, joints=robot.joint_names if joints is None else joints, **changes)


def host_context(name: str = "subject", **changes: Any) -> Context:
    """A context as in the host process: it has a bus.

    Args:
        name: the component's name.
        changes: any other field of `Context`.
    """
    clock: Clock = changes.pop("clock", None) or SteppedClock(START_NS)
    return control_context(name, joints=(), clock=clock, bus=changes.pop("bus", None) or Bus(clock), **changes)

"""An operator whose hand is at a pose, and a robot that goes where it should, by a stepped clock."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import attrs
import numpy as np
from ibrobot_kinematics import robot_model
from ibrobot_testing import host_context
from ibrobot_webxr.messages import HandPose, Hands
from ibrobot_webxr.options import WebxrOptions
from ibrobot_webxr.server import PageServer
from ibrobot_webxr.shared import close_page, open_page
from ibrobot_webxr.teleop import WebxrTeleop

from ibrobot_core.api import Context, Description, Joint, JointReading, Robot, SteppedClock, TeleopCommand, Vector, ns

from .conftest import AXES

BENT = np.array([0.0, -1.1, 1.5, -0.4, 0.2, 0.4])
UPRIGHT = (0.0, 0.0, 0.0, 1.0)
TICK_S = 0.01
FRAME = 2
"""Ticks between the poses of the page."""
ANY_PORT = WebxrOptions(port=0)


def robot_of(mjcf: Path) -> Robot:
    joints = tuple(Joint(name, -2.4, 2.4, max_velocity=3.0, max_acceleration=40.0) for name in AXES)
    groups = {"arm": tuple(AXES)[:5], "gripper": ("gripper",)}
    return Robot("tester", joints, groups=groups, description=Description(mjcf=mjcf, tip="tool"))


@contextmanager
def page_of(options: WebxrOptions, ctx: Context) -> Iterator[PageServer]:
    """The page that the devices of a context share."""
    try:
        yield open_page(options, ctx)
    finally:
        close_page(options, ctx)


@attrs.define
class Rig:
    """A teleop with its page, whose poses come from here in place of a browser."""

    mjcf: Path
    options: WebxrOptions = ANY_PORT
    position: Vector = attrs.field(factory=BENT.copy)
    sag: Vector = attrs.field(factory=lambda: np.zeros(6))
    """How far the robot is from its setpoints [rad]."""
    side: str = "right"
    at: Vector = attrs.field(factory=lambda: np.array([0.1, 1.2, -0.3]))
    """Position of the hand in WebXR's frame [m]."""
    orientation: tuple[float, ...] = UPRIGHT
    clutch: bool = False
    trigger: float | None = None
    open: float = 0.0
    move: tuple[float, ...] = (0.0, 0.0, 0.0)
    heading: float = 0.0
    has_position: bool = True
    tracked: bool = True
    connected: bool = True
    ctx: Context = attrs.field(init=False)
    teleop: WebxrTeleop = attrs.field(init=False)
    setpoint: Vector | None = None
    last: TeleopCommand = TeleopCommand(None)
    _count: int = 0

    def __attrs_post_init__(self) -> None:
        self.ctx = host_context("hand", robot=robot_of(self.mjcf), clock=SteppedClock(ns(1000.0)))
        self.teleop = WebxrTeleop(self.options, self.ctx)
        self.teleop.connect()
        self.teleop.begin_operation(self.measured())

    def measured(self) -> JointReading:
        return JointReading(self.ctx.clock.now_ns(), self.position + self.sag, np.zeros(6), np.zeros(6))

    @property
    def page(self) -> PageServer:
        with page_of(self.options, self.ctx) as page:
            return page

    def send(self, late_s: float = 0.0) -> None:
        self.page.exchange.put(Hands(self._count, self.ctx.clock.now_ns() * 1e-9, self.heading, self.hands()), late_s)

    def hands(self) -> Mapping[str, HandPose]:
        if not self.tracked:
            return {}
        position = tuple(self.at.tolist()) if self.has_position else None
        return {self.side: HandPose(self.orientation, position, self.clutch, self.trigger, self.open, self.move)}

    def tick(self, count: int = 1) -> TeleopCommand:
        """Let time pass; the robot follows its setpoints."""
        for _ in range(count):
            self.ctx.clock.sleep_until(self.ctx.clock.now_ns() + ns(TICK_S))
            if self.connected and self._count % FRAME == 0:
                self.send()
            self._count += 1
            self.last = self.teleop.operate(self.measured())
            if self.last.positions is not None:
                self.setpoint = np.array([self.last.positions[name] for name in AXES])
                self.position = self.setpoint
        return self.last

    def press(self) -> TeleopCommand:
        """Release the clutch, and press it again."""
        self.clutch = False
        self.tick(4)
        self.clutch = True
        return self.tick(2)

    def go(self, way: tuple[float, float, float], seconds: float = 0.5) -> None:
        """Move the hand [m], in WebXR's frame, and wait until the tool is there."""
        steps = round(seconds / TICK_S)
        for _ in range(steps):
            self.at = self.at + np.array(way) / steps
            self.tick()
        self.tick(60)

    def tip(self) -> Vector:
        robot = self.ctx.robot
        arm = robot.groups["arm"]
        return robot_model(robot, arm).forward(self.position[robot.indices(arm)]).position

    def rotation(self) -> Vector:
        robot = self.ctx.robot
        arm = robot.groups["arm"]
        return robot_model(robot, arm).forward(self.position[robot.indices(arm)]).rotation

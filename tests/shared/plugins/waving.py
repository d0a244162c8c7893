"""A teleoperation device for tests that waves with the first joint, by itself, from where the robot is."""

from __future__ import annotations

import math

from ibrobot_core.api import Options, Teleop, TeleopCommand, TeleopDescriptor, hookimpl


class Waving(Teleop):
    """Waves by 0.3 rad, once in two seconds."""

    operated = False

    def __init__(self, options, ctx):
        self._robot, self._begun_ns = ctx.robot, 0

    def connect(self):
        pass

    def activate(self, measured):
        self._begun_ns, self._from = measured.stamp_ns, measured.position.copy()

    def read(self, measured):
        wave = 0.3 * math.sin(math.pi * (measured.stamp_ns - self._begun_ns) * 1e-9)
        positions = dict(zip(self._robot.joint_names, self._from.tolist(), strict=True))
        positions[self._robot.joint_names[0]] += wave
        return TeleopCommand(positions)

    def disconnect(self):
        pass


@hookimpl
def ibrobot_teleop():
    yield TeleopDescriptor(type="waving", options=Options, make=Waving, summary="waves")

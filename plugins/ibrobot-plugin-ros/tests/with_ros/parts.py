"""A simulated arm with a gripper, for runs beside ROS. A thing between the fingers stops them at `OBJECT`."""

from __future__ import annotations

import numpy as np
from ibrobot_testing.fakes import FakeHardware, FakePolicy, FakeTeleop

from ibrobot_core.api import HardwareDescriptor, PolicyDescriptor, TeleopDescriptor, hookimpl

OBJECT = 0.3


class Arm(FakeHardware):
    def advance(self, step_ns):
        grip = self.joints.index("grip")
        before = self._position[grip]
        super().advance(step_ns)
        if self._position[grip] < OBJECT <= before:
            self._position[grip] = OBJECT
            self._velocity[grip] = 0.0
        elif before == OBJECT and self._command[grip] < OBJECT:
            self._position[grip], self._velocity[grip] = OBJECT, 0.0

    def reset(self, episode):
        super().reset(episode)
        self._position = np.array([0.0, 0.0, 0.0, 0.8])[: len(self.joints)]
        self._command = self._position.copy()


@hookimpl
def ibrobot_hardware():
    yield HardwareDescriptor("arm", lambda options, ctx: Arm(ctx, 0.03), "an arm with a gripper", simulated=True)


class Stick(FakeTeleop):
    """Pushed forward: once, then for good."""

    def __init__(self, ctx):
        super().__init__(ctx)
        self.velocity = -0.1

    def activate(self, measured):
        super().activate(measured)
        self.press()


@hookimpl
def ibrobot_teleop():
    yield TeleopDescriptor("stick", lambda options, ctx: Stick(ctx), "a stick that is pushed forward")


@hookimpl
def ibrobot_policies():
    yield PolicyDescriptor("net", lambda options, ctx: FakePolicy(ctx), "a policy that moves all joints")

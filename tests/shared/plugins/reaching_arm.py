"""A made-up arm that is no simulation, a camera, and a policy that moves the arm."""

from __future__ import annotations

from ibrobot_testing.fakes import FakePolicy, FakeRealHardware, FakeSensor

from ibrobot_core.api import HardwareDescriptor, PolicyDescriptor, SensorDescriptor, Torque, hookimpl


class Arm(FakeRealHardware):
    def relax(self):
        return Torque.OFF


@hookimpl
def ibrobot_hardware():
    yield HardwareDescriptor("made_up_arm", lambda options, ctx: Arm(ctx), "an arm")


@hookimpl
def ibrobot_policies():
    yield PolicyDescriptor("reaching", lambda options, ctx: FakePolicy(ctx), "reaches somewhere")


@hookimpl
def ibrobot_sensors():
    yield SensorDescriptor("made_up_camera", lambda options, ctx: FakeSensor(ctx, 64, 48), "a camera")

"""A made-up arm that is no simulation, and a policy that moves it."""

from __future__ import annotations

from ibrobot_testing.fakes import FakePolicy, FakeRealHardware

from ibrobot_core.api import HardwareDescriptor, PolicyDescriptor, Torque, hookimpl


class Arm(FakeRealHardware):
    def relax(self):
        return Torque.OFF


@hookimpl
def ibrobot_hardware():
    yield HardwareDescriptor("made_up_arm", lambda options, ctx: Arm(ctx), "an arm")


@hookimpl
def ibrobot_policies():
    yield PolicyDescriptor("reaching", lambda options, ctx: FakePolicy(ctx), "reaches somewhere")

"""An arm that a made-up distribution offers."""

from __future__ import annotations

from collections.abc import Iterator

from ibrobot_testing.fakes import FakeHardware

from ibrobot_core.api import HardwareDescriptor, hookimpl


@hookimpl
def ibrobot_hardware() -> Iterator[HardwareDescriptor]:
    yield HardwareDescriptor(type="arm", make=lambda options, ctx: FakeHardware(ctx), summary="an arm")

"""New packages for plugin authors: `ibrobot plugins new` and `check`, and what their robot YAMLs need."""

from __future__ import annotations

from collections.abc import Iterable

from ibrobot_core.api import HardwareDescriptor, Late, PolicyDescriptor, hookimpl
from ibrobot_core.app import Command


@hookimpl
def ibrobot_commands() -> Iterable[Command]:
    """Commands for authors."""
    yield Command("plugins check", Late("ibrobot_kit.check:CheckPlugin"))
    yield Command("plugins new", Late("ibrobot_kit.new:NewPlugin"))


@hookimpl
def ibrobot_hardware() -> Iterable[HardwareDescriptor]:
    """Simulated joints, for tries of whatever moves or watches them."""
    make = Late("ibrobot_testing.fakes.control:FakeHardware")
    yield HardwareDescriptor(
        "fake", lambda options, ctx: make(ctx), "joints that follow their commands, without a physical model",
        simulated=True,
    )  # fmt: skip


@hookimpl
def ibrobot_policies() -> Iterable[PolicyDescriptor]:
    """A policy, for tries of engines."""
    make = Late("ibrobot_testing.fakes.host:FakePolicy")
    yield PolicyDescriptor(
        "fake", lambda options, ctx: make(ctx), "moves each joint to a random position, without weights"
    )

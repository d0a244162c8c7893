"""New packages for plugin authors: `ibrobot plugins new` and `check`, and what their robot YAMLs need."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from ibrobot_core.api import Descriptor, HardwareDescriptor, Late, PolicyDescriptor, hookimpl
from ibrobot_core.app import Command, Kind

_BEGIN_AS: Mapping[str, str] = {
    "hardware": "control:FakeRealHardware",
    "camera": "host:FakeSensor",
    "sensor": "host:FakeImu",
    "teleop": "host:FakeTeleop",
    "policy": "host:FakePolicy",
    "engine": "host:FakeEngine",
    "executor": "control:FakeExecutor",
    "source": "run:FakeSourceCommand",
    "transport": "transport:FakeTransport",
    "recorder": "storage:FakeRecorder",
    "reader": "storage:FakeReader",
    "viewer": "host:FakeViewer",
    "terminal": "run:FakeTerminal",
    "section": "run:FakeSection",
    "command": "run:FakeCommand",
    "config": "run:fake_config",
    "message": "formats:FakeMessage",
    "decoder": "formats:decode_fake",
    "feature": "formats:fake_feature",
    "units": "formats:FakeUnits",
}
"""Kind of core, or `camera` for a sensor of pictures -> the fake from which its package begins.

It is the smallest implementation that passes the suite of the kind."""


@hookimpl
def ibrobot_commands() -> Iterable[Command]:
    """Commands for authors."""
    yield Command("plugins check", Late("ibrobot_kit.check:CheckPlugin"))
    yield Command("plugins new", Late("ibrobot_kit.new:NewPlugin"))


@hookimpl
def ibrobot_kinds() -> Iterable[Kind]:
    """What packages begin with."""
    yield Kind("sample", "ibrobot_samples", Descriptor)


@hookimpl
def ibrobot_samples() -> Iterable[Descriptor[Any]]:
    """What `ibrobot plugins new` begins with, for the kinds of core."""
    for kind, place in _BEGIN_AS.items():
        yield Descriptor(kind, Late(f"ibrobot_testing.fakes.{place}"), f"a small {kind}")


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

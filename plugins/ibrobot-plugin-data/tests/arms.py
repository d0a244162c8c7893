"""A plugin for tests: two arms, one of them in a scene; a stick, a policy and a recorder."""

from __future__ import annotations

from collections.abc import Iterator
from typing import override

import attrs
from ibrobot_testing.fakes import FakeHardware, FakePolicy, FakeRealHardware, FakeRecorder, FakeTeleop

from ibrobot_core.api import (
    Context,
    EpisodeSetup,
    HardwareDescriptor,
    JointReading,
    OperatorEvent,
    Options,
    PolicyDescriptor,
    RecorderDescriptor,
    TeleopCommand,
    TeleopDescriptor,
    hookimpl,
)
from ibrobot_core.app import Component, SectionDescriptor

STICKS: list[Stick] = []
"""Those made so far."""
ENDED: list[tuple[int, str]] = []
"""Number and outcome of each episode that has ended."""


class Scene(FakeHardware):
    """Succeeds after half a second, but never with seed 13."""

    @override
    def reset(self, episode: EpisodeSetup) -> None:
        super().reset(episode)
        self.ticks, self.seed = 0, episode.seed

    @override
    def advance(self, step_ns: int) -> None:
        super().advance(step_ns)
        self.ticks += 1

    @override
    def success(self) -> bool:
        return self.seed != 13 and self.ticks >= 25


class Stick(FakeTeleop):
    """Pushed forward, all the time."""

    operated = False

    def __init__(self, ctx: Context) -> None:
        super().__init__(ctx)
        self.velocity = 0.2
        self.approaching = False
        STICKS.append(self)

    @override
    def activate(self, measured: JointReading) -> None:
        super().activate(measured)
        self.pressed = True

    @override
    def read(self, measured: JointReading) -> TeleopCommand:
        return attrs.evolve(super().read(measured), approaching=self.approaching)


class PadOptions(Options):
    @override
    def events(self) -> tuple[OperatorEvent, ...]:
        return ("start", "success")


@hookimpl
def ibrobot_hardware() -> Iterator[HardwareDescriptor]:
    yield HardwareDescriptor("scene", lambda options, ctx: Scene(ctx), "a scene", simulated=True)
    yield HardwareDescriptor("arm", lambda options, ctx: FakeRealHardware(ctx), "an arm")


@hookimpl
def ibrobot_teleop() -> Iterator[TeleopDescriptor]:
    yield TeleopDescriptor("stick", lambda options, ctx: Stick(ctx), "a stick")
    pad = lambda options, ctx: Stick(ctx)  # noqa: E731
    yield TeleopDescriptor("pad", pad, "a stick with buttons", PadOptions)


@hookimpl
def ibrobot_policies() -> Iterator[PolicyDescriptor]:
    yield PolicyDescriptor("net", lambda options, ctx: FakePolicy(ctx), "a network")


@hookimpl
def ibrobot_recorders() -> Iterator[RecorderDescriptor]:
    yield RecorderDescriptor("lines", lambda options, ctx: FakeRecorder(ctx), "lines of JSON")


class PhoneOptions(Options):
    @override
    def offers(self, service: str) -> bool:
        return service == "/record_episode"


class Phone(Component):
    """Lets other programs call services, in the imagination."""

    def start(self) -> None: ...

    def stop(self) -> None: ...


@hookimpl
def ibrobot_sections() -> Iterator[SectionDescriptor]:
    yield SectionDescriptor(
        type="phone",
        make=lambda options, session: Phone("phone", "a phone"),
        summary="a phone",
        options=PhoneOptions,
    )


@hookimpl
def ibrobot_episode_ended(episode: int, outcome: str) -> None:
    ENDED.append((episode, outcome))

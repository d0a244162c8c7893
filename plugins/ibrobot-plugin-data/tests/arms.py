"""A plugin for tests: two arms, one of them in a scene."""

from __future__ import annotations

from collections.abc import Iterator
from typing import override

from ibrobot_testing.fakes import FakeHardware, FakeRealHardware

from ibrobot_core.api import EpisodeSetup, HardwareDescriptor, hookimpl


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


@hookimpl
def ibrobot_hardware() -> Iterator[HardwareDescriptor]:
    yield HardwareDescriptor("scene", lambda options, ctx: Scene(ctx), "a scene", simulated=True)
    yield HardwareDescriptor("arm", lambda options, ctx: FakeRealHardware(ctx), "an arm")

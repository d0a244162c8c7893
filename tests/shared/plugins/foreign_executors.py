"""Executors as somebody else's plugin offers them: one takes goal positions, one streams with options of its own."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import attrs
from ibrobot_testing.fakes import FakeExecutor

from ibrobot_core.api import Context, ExecutorDescriptor, Options, hookimpl, option


@attrs.frozen
class GivenOptions(Options):
    """GivenOptions that derive from nothing."""

    stiffness: float = option(1.0, help="of nothing")


def nearest(options: Any, ctx: Context) -> FakeExecutor:
    return FakeExecutor(ctx)


@hookimpl
def ibrobot_executors() -> Iterator[ExecutorDescriptor]:
    yield ExecutorDescriptor("nearest", nearest, "follows the nearest point of a plan", GivenOptions, streams=True)

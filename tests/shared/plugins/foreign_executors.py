"""Executors as somebody else's plugin offers them: one takes goal positions, one streams with options of its own."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, override

import attrs
from ibrobot_testing.fakes import FakeExecutor

from ibrobot_core.api import Context, ExecutorDescriptor, JointReading, hookimpl, option


@attrs.frozen
class Options:
    """Options that derive from nothing."""

    stiffness: float = option(1.0, help="of nothing")


class Approaches(FakeExecutor):
    """Takes `{"position": q}`, for its first joint."""

    @override
    def set_goal(self, goal_id: str, goal: Mapping[str, Any], measured: JointReading) -> None:
        super().set_goal(goal_id, {"position": [goal["position"]]}, measured)


def approaches(options: Any, ctx: Context) -> FakeExecutor:
    return Approaches(ctx)


def nearest(options: Any, ctx: Context) -> FakeExecutor:
    return FakeExecutor(ctx)


@hookimpl
def ibrobot_executors() -> Iterator[ExecutorDescriptor]:
    yield ExecutorDescriptor("approach", approaches, "approaches a position", goals="position")
    yield ExecutorDescriptor("nearest", nearest, "follows the nearest point of a plan", Options, streams=True)

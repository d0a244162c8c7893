"""A plugin for tests: an arm in a scene."""

from __future__ import annotations

from collections.abc import Iterator

from ibrobot_testing.fakes import FakeHardware, FakePlanner, FakeRealHardware, FakeTrajectoryExecutor

from ibrobot_core.api import ExecutorDescriptor, HardwareDescriptor, PlannerDescriptor, hookimpl


@hookimpl
def ibrobot_hardware() -> Iterator[HardwareDescriptor]:
    yield HardwareDescriptor("scene", lambda options, ctx: FakeHardware(ctx), "a scene", simulated=True)
    yield HardwareDescriptor("arm", lambda options, ctx: FakeRealHardware(ctx), "an arm")


@hookimpl
def ibrobot_planners() -> Iterator[PlannerDescriptor]:
    yield PlannerDescriptor("cubic", lambda options, ctx: FakePlanner(ctx), "a planner of another plugin")


@hookimpl
def ibrobot_executors() -> Iterator[ExecutorDescriptor]:
    yield ExecutorDescriptor("waypoints", lambda options, ctx: FakeTrajectoryExecutor(ctx), "along straight lines")

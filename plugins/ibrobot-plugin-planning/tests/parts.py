"""A plugin for tests: an arm in a scene."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import override

from ibrobot_planning.planner import PlannerDescriptor
from ibrobot_planning.suite import FakePlanner
from ibrobot_testing.fakes import (
    FakeHardware,
    FakePolicy,
    FakeRealHardware,
    FakeRecorder,
    FakeSensor,
    FakeTrajectoryExecutor,
)

from ibrobot_core.api import (
    ExecutorDescriptor,
    HardwareDescriptor,
    Options,
    PolicyDescriptor,
    Pose,
    RecorderDescriptor,
    Robot,
    SceneObject,
    SensorDescriptor,
    Vector3,
    hookimpl,
)

POSES = "/scene/poses"
SCENE = (
    SceneObject("floor", "plane", (), Pose(Vector3(0.0, 0.0, -0.1))),
    SceneObject("post", "capsule", (0.02, 0.1), Pose(Vector3(0.4, 0.3, 0.1))),
    SceneObject("cube", "box", (0.02, 0.02, 0.02), Pose(Vector3(0.2, 0.05, 0.06)), POSES, 0),
    SceneObject("ball", "sphere", (0.02,), Pose(Vector3(0.0, 0.3, 0.3)), POSES, 7),
    SceneObject("can", "cylinder", (0.02, 0.1), Pose(Vector3(0.3, -0.3, 0.05))),
)


class SceneOptions(Options):
    @override
    def scene_objects(self, robot: Robot) -> Sequence[SceneObject]:
        return SCENE


@hookimpl
def ibrobot_hardware() -> Iterator[HardwareDescriptor]:
    yield HardwareDescriptor("scene", lambda options, ctx: FakeHardware(ctx), "a scene", SceneOptions, simulated=True)
    yield HardwareDescriptor("arm", lambda options, ctx: FakeRealHardware(ctx), "an arm")


@hookimpl
def ibrobot_planners() -> Iterator[PlannerDescriptor]:
    yield PlannerDescriptor("cubic", lambda options, ctx: FakePlanner(ctx), "a planner of another plugin")


@hookimpl
def ibrobot_executors() -> Iterator[ExecutorDescriptor]:
    yield ExecutorDescriptor("waypoints", lambda options, ctx: FakeTrajectoryExecutor(ctx), "along straight lines")


@hookimpl
def ibrobot_policies() -> Iterator[PolicyDescriptor]:
    yield PolicyDescriptor("wave", lambda options, ctx: FakePolicy(ctx), "a policy")


@hookimpl
def ibrobot_sensors() -> Iterator[SensorDescriptor]:
    yield SensorDescriptor("eye", lambda options, ctx: FakeSensor(ctx), "a camera", kind="camera")


@hookimpl
def ibrobot_recorders() -> Iterator[RecorderDescriptor]:
    yield RecorderDescriptor("lines", lambda options, ctx: FakeRecorder(ctx), "joint states")

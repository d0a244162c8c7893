"""Minimal correct implementations of each kind, for tests and as examples."""

from ibrobot_testing.fakes.control import FakeExecutor, FakeHardware, FakeRealHardware, FakeTrajectoryExecutor
from ibrobot_testing.fakes.host import (
    FakeEngine,
    FakeImu,
    FakePolicy,
    FakeSensor,
    FakeSource,
    FakeTeleop,
    FakeViewer,
)
from ibrobot_testing.fakes.storage import FakeReader, FakeRecorder
from ibrobot_testing.fakes.transport import FakeTransport

__all__ = [
    "FakeEngine",
    "FakeExecutor",
    "FakeHardware",
    "FakeImu",
    "FakePolicy",
    "FakeReader",
    "FakeRealHardware",
    "FakeRecorder",
    "FakeSensor",
    "FakeSource",
    "FakeTeleop",
    "FakeTrajectoryExecutor",
    "FakeTransport",
    "FakeViewer",
]

"""The parts of a robot for tests of `ibrobot launch`."""

from __future__ import annotations

import signal
from typing import Never

import attrs
from ibrobot_testing.fakes import (
    FakeHardware,
    FakePolicy,
    FakeRealHardware,
    FakeSource,
    FakeTeleop,
    FakeTrajectoryExecutor,
)

from ibrobot_core import hookimpl
from ibrobot_core.descriptors import (
    Descriptor,
    EngineDescriptor,
    ExecutorDescriptor,
    HardwareDescriptor,
    Kind,
    Late,
    PolicyDescriptor,
    RecorderDescriptor,
    SensorDescriptor,
    SourceDescriptor,
    TeleopDescriptor,
    TransportDescriptor,
)
from ibrobot_core.errors import HardwareError, MissingDependency, TeleopError
from ibrobot_core.interfaces.hardware import Holding

try:
    from ibrobot_planning.planner import PlannerDescriptor
except ImportError:  # any class of descriptors will do
    PlannerDescriptor = Descriptor  # type: ignore[assignment, misc]


@hookimpl
def ibrobot_kinds():
    yield Kind("planner", "ibrobot_planners", PlannerDescriptor)


class Scene(FakeHardware):
    """Done after half a second, but never with seed 13; silent after two seconds with seed 66; seed 7 holds torque."""

    def holding(self):
        return Holding("/dev/ttyARM", "arm torque off") if self.seed == 7 else None

    def reset(self, episode):
        super().reset(episode)
        self.ticks, self.seed = 0, episode.seed

    def advance(self, step_ns):
        super().advance(step_ns)
        self.ticks += 1

    def success(self):
        return self.seed not in (13, 66) and self.ticks >= 25

    def read(self):
        if self.seed == 66 and self.ticks > 100:
            raise HardwareError("the bus is silent")
        return super().read()


class Stick(FakeTeleop):
    """Pulled out after a second."""

    reads = 0

    def read(self, measured):
        self.reads += 1
        if self.reads > 50:
            raise TeleopError("the stick is gone")
        return super().read(measured)


class Bug(FakeTeleop):
    """Fails in a way that nobody foresaw."""

    def read(self, measured):
        raise ZeroDivisionError("one over nothing")


class Person(FakeTeleop):
    """Presses Ctrl-C after a second."""

    reads = 0

    def read(self, measured):
        self.reads += 1
        if self.reads == 50:
            signal.raise_signal(signal.SIGINT)
        return super().read(measured)


class Cautious(FakeTeleop):
    """Stops the robot after a second."""

    reads = 0

    def read(self, measured):
        self.reads += 1
        return attrs.evolve(super().read(measured), estop=self.reads == 50)


def no_library():
    raise MissingDependency("no OpenGL", apt=["libegl1"])


def unused(options: object, ctx: object) -> Never:
    raise NotImplementedError("nothing makes one")


@hookimpl
def ibrobot_sensors():
    yield SensorDescriptor("camera", unused, "a camera that cannot run here", check=no_library)


@hookimpl
def ibrobot_recorders():
    yield RecorderDescriptor("unused", unused, "a recorder")


@hookimpl
def ibrobot_hardware():
    yield HardwareDescriptor("scene", lambda options, ctx: Scene(ctx), "a scene", simulated=True)
    yield HardwareDescriptor("arm", lambda options, ctx: FakeRealHardware(ctx), "an arm")


@hookimpl
def ibrobot_transports():
    yield TransportDescriptor("net", unused, "a network")


@hookimpl
def ibrobot_engines():
    yield EngineDescriptor("far", unused, "elsewhere", uses_transport=True, weights_here=False)


@hookimpl
def ibrobot_policies():
    yield PolicyDescriptor("net", lambda options, ctx: FakePolicy(ctx), "a network")


@hookimpl
def ibrobot_teleop():
    yield TeleopDescriptor("stick", lambda options, ctx: Stick(ctx), "a stick")
    yield TeleopDescriptor("bug", lambda options, ctx: Bug(ctx), "a bug")
    yield TeleopDescriptor("person", lambda options, ctx: Person(ctx), "a person")
    yield TeleopDescriptor("cautious", lambda options, ctx: Cautious(ctx), "a person")


@hookimpl
def ibrobot_sources():
    yield SourceDescriptor("planner", make=FakeSource, summary="holds")


@hookimpl
def ibrobot_planners():
    yield PlannerDescriptor("cubic", Late("nowhere:Cubic"), "cubics")


@hookimpl
def ibrobot_executors():
    yield ExecutorDescriptor("waypoints", lambda options, ctx: FakeTrajectoryExecutor(ctx), "along straight lines")

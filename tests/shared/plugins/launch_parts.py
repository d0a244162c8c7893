"""The parts of a robot for tests of the runtime."""

from __future__ import annotations

import time
from typing import Any

import attrs
from ibrobot_testing.fakes import (
    FakeEngine,
    FakeHardware,
    FakePolicy,
    FakeRealHardware,
    FakeRecorder,
    FakeSensor,
    FakeSource,
    FakeTeleop,
    FakeTrajectoryExecutor,
)

from ibrobot_core import hookimpl
from ibrobot_core.api import Options
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
)
from ibrobot_core.errors import HardwareError, MissingDependency, PolicyError, SensorError
from ibrobot_core.interfaces.hardware import Holding
from ibrobot_core.options import option

EVENTS: list[tuple[Any, ...]] = []
CALLS: list[str] = []
MADE: dict[str, Any] = {}
TROUBLE: dict[str, str] = {}

try:
    from ibrobot_planning.planner import PlannerDescriptor
except ImportError:  # any class of descriptors will do
    PlannerDescriptor = Descriptor  # type: ignore[assignment, misc]


@hookimpl
def ibrobot_kinds():
    yield Kind("planner", "ibrobot_planners", PlannerDescriptor)


class Scene(FakeHardware):
    """Done after half a second, but never with seed 13; `broken` makes it silent."""

    broken = False

    def reset(self, episode):
        super().reset(episode)
        self.ticks, self.seed = 0, episode.seed

    def advance(self, step_ns):
        super().advance(step_ns)
        self.ticks += 1

    def success(self):
        return self.seed != 13 and self.ticks >= 25

    def read(self):
        if self.broken:
            raise HardwareError("the bus is silent")
        return super().read()

    def reset_faults(self):
        self.broken = False

    def holding(self):
        return None if self.relaxed else Holding("the scene", "scene torque off")


class Camera(FakeSensor):
    """50 Hz in real time; `TROUBLE` says which one is missing, has a bug, is unplugged at frame six, or stays open."""

    frames = 0

    def open(self):
        trouble = TROUBLE.get(self._ctx.name)
        if trouble == "missing":
            raise SensorError("no such device")
        if trouble == "bug":
            raise ZeroDivisionError("one over nothing")
        CALLS.append("open " + self._ctx.name)
        super().open()

    def read(self, timeout_s):
        self.frames += 1
        if self.frames > 5 and TROUBLE.get(self._ctx.name) == "unplugged":
            raise SensorError("unplugged")
        time.sleep(min(timeout_s, 0.02))
        return super().read(timeout_s)

    def close(self):
        if TROUBLE.get(self._ctx.name) == "stays open":
            raise OSError("the port is gone")
        CALLS.append("close " + self._ctx.name)
        super().close()


class Stick(FakeTeleop):
    """Pushed forward, all the time."""

    operated = False

    def __init__(self, ctx):
        super().__init__(ctx)
        self.velocity = 0.2

    def activate(self, measured):
        super().activate(measured)
        self.pressed = True

    def connect(self):
        CALLS.append("connect stick")
        super().connect()

    def disconnect(self):
        CALLS.append("disconnect stick")
        super().disconnect()


class Net(FakePolicy):
    seeds: tuple[int, ...] = ()

    def load(self):
        CALLS.append("load net")

    def close(self):
        CALLS.append("close net")

    def reset(self, seed):
        super().reset(seed)
        self.seeds = (*self.seeds, seed)


class Continuing(Net):
    """Does what is planned already, and then what `Net` would."""

    def __init__(self, ctx):
        super().__init__(ctx)
        self.spec = attrs.evolve(self.spec, prefix=True)

    def preprocess(self, frame):
        prefix = frame.values["observation.state"][:0].reshape(0, 2) if frame.prefix is None else frame.prefix
        return {**super().preprocess(frame), "prefix": prefix}

    def infer(self, tensors):
        return {**super().infer(tensors), "prefix": tensors["prefix"]}

    def postprocess(self, tensors):
        chunk = super().postprocess(tensors)
        chunk[: len(tensors["prefix"])] = tensors["prefix"]
        return chunk


class Seeing(Net):
    """Looks through the camera on top."""

    def __init__(self, ctx):
        super().__init__(ctx)
        seen = {**self.spec.observations, "observation.images.top": (-1, -1, 3)}
        self.spec = attrs.evolve(self.spec, observations=seen)


class Lost(Net):
    def load(self):
        raise PolicyError("no such checkpoint")


@attrs.frozen
class FarOptions(Options):
    server: str = option("", help="where the model is")


class Far(FakeEngine):
    def __init__(self, options, ctx):
        super().__init__(ctx, "far")
        MADE["far"] = self
        self.options, self.name = options, ctx.name


class DrawnOptions(Options):
    def find_device(self):
        if TROUBLE.get("unplugged"):
            raise MissingDependency("/dev/video0: there is no such device", remedy="plug it in")


def can_draw():
    if "no OpenGL" in TROUBLE:
        raise MissingDependency("no OpenGL", apt=["libegl1", "libopengl0"])


def make(kind):
    def make_it(options, ctx):
        MADE[ctx.name] = kind(ctx)
        return MADE[ctx.name]

    return make_it


@hookimpl
def ibrobot_hardware():
    yield HardwareDescriptor("scene", make(Scene), "a scene", simulated=True, sensors={"camera": "drawn"})
    yield HardwareDescriptor("arm", make(FakeRealHardware), "an arm")


@hookimpl
def ibrobot_sensors():
    yield SensorDescriptor("webcam", make(Camera), "a camera")
    yield SensorDescriptor("drawn", make(Camera), "a camera in the scene", DrawnOptions, check=can_draw)
    yield SensorDescriptor("imu", make(Camera), "a sensor of a kind of its own", kind="imu", check=can_draw)


@hookimpl
def ibrobot_policies():
    yield PolicyDescriptor("net", make(Net), "a network")
    yield PolicyDescriptor("continuing", make(Continuing), "a network that continues the plan")
    yield PolicyDescriptor("seeing", make(Seeing), "a network with eyes")
    yield PolicyDescriptor("lost", make(Lost), "a network that is not there")


@hookimpl
def ibrobot_engines():
    yield EngineDescriptor("far", Far, "far away", FarOptions, uses_transport=True, weights_here=False)


@hookimpl
def ibrobot_teleop():
    yield TeleopDescriptor("stick", make(Stick), "a stick")
    yield TeleopDescriptor("lever", make(FakeTeleop), "a lever with a deadman")


@hookimpl
def ibrobot_sources():
    yield SourceDescriptor("planner", make=FakeSource, summary="holds")


@hookimpl
def ibrobot_planners():
    yield PlannerDescriptor("cubic", Late("nowhere:Cubic"), "cubics")


@hookimpl
def ibrobot_recorders():
    yield RecorderDescriptor("lines", make(FakeRecorder), "lines of JSON")


@hookimpl
def ibrobot_episode_started(episode, mode):
    EVENTS.append(("started", episode, mode))


@hookimpl
def ibrobot_episode_ended(episode, outcome):
    EVENTS.append(("ended", episode, outcome))


@hookimpl
def ibrobot_mode_changed(mode, previous):
    EVENTS.append(("mode", previous, mode))


@hookimpl
def ibrobot_fault_raised(fault):
    EVENTS.append(("fault", fault))


@hookimpl
def ibrobot_executors():
    yield ExecutorDescriptor("waypoints", lambda options, ctx: FakeTrajectoryExecutor(ctx), "along straight lines")

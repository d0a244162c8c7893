"""Parts that write down what happens to them, so that it is known after a kill."""

from __future__ import annotations

import math
import os
import signal
import sys
import threading
import time

import attrs
from ibrobot_testing.fakes import FakePolicy, FakeRealHardware, FakeSensor, FakeTeleop

from ibrobot_core import hookimpl
from ibrobot_core.api import Options
from ibrobot_core.control import host, pose_motion
from ibrobot_core.descriptors import HardwareDescriptor, PolicyDescriptor, SensorDescriptor, TeleopDescriptor
from ibrobot_core.errors import PolicyError, SensorError
from ibrobot_core.interfaces import TeleopCommand, Torque
from ibrobot_core.options import option

# A way is gone by ticks: on a busy machine, which misses some, it takes longer.
pose_motion.TIMEOUT_S = host._STOP_TIMEOUT_S = 60.0


def block_main(number, frame):
    os.write(2, b"the main thread is blocked\n")
    time.sleep(60)


signal.signal(signal.SIGUSR1, block_main)


class Arm(FakeRealHardware):
    """Logs every command with the time; `trouble` is a bug after a second."""

    def __init__(self, options, ctx):
        super().__init__(ctx)
        self._options = options
        self._log = os.open(options.log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        self._reads = 0

    def connect(self):
        super().connect()
        if self._options.fork and os.fork() == 0:
            time.sleep(60)
            os._exit(0)

    def read(self):
        self._reads += 1
        if self._options.trouble and self._reads > 100:
            return 1 / 0
        return super().read()

    def write(self, position):
        super().write(position)
        self._note("write", *map(repr, position.tolist()))

    def relax(self):
        self._note("relax")
        return Torque.OFF

    def _note(self, *words):
        os.write(self._log, (" ".join([words[0], str(time.monotonic_ns()), *words[1:]]) + "\n").encode())


@attrs.frozen
class ArmOptions(Options):
    log: str = option(help="file")
    trouble: bool = option(False, help="whether it has a bug")
    fork: bool = option(False, help="whether a child outlives the control process")


class Swing(FakeTeleop):
    """Swings every joint about its start; with `fork`, a child of the host outlives it."""

    operated = False

    def __init__(self, options, ctx):
        super().__init__(ctx)
        self._options = options
        self._ctx = ctx
        self._reads = 0

    def connect(self):
        super().connect()
        if self._options.fork and os.fork() == 0:
            time.sleep(60)
            os._exit(0)
        if self._options.thread:
            threading.Timer(3.0, self._die).start()
            threading.enumerate()[-1].name = "swing helper"

    def _die(self):
        if self._options.thread == "exit":
            sys.exit("a helper ended itself")
        raise RuntimeError("a helper broke")

    def _make_trouble(self):
        match self._options.trouble:
            case "block":
                time.sleep(60)
            case "exit":
                sys.exit("a device ended it")
            case "main":  # the main thread waits in a library, without the interpreter's lock
                signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGUSR1)
            case "link":
                self._ctx.bus.publish = lambda *_: time.sleep(60)

    def activate(self, measured):
        super().activate(measured)
        self._start = (measured.stamp_ns, measured.position.copy())

    def read(self, measured):
        self._reads += 1
        if self._reads == 300 and self._options.trouble:
            self._make_trouble()
        if self._options.chatter:
            self._ctx.log.warning("chatter " * 1000)
        begun_ns, middle = self._start
        swung = middle + 0.6 * math.sin(4.0 * (measured.stamp_ns - begun_ns) * 1e-9)
        return TeleopCommand(dict(zip(self._names, swung.tolist(), strict=True)))


@attrs.frozen
class SwingOptions(Options):
    fork: bool = option(False, help="whether a child outlives the host")
    thread: str = option("", help="how a thread of it dies: raise, exit")
    trouble: str = option("", help="what happens after three seconds: block, exit, main, link")
    chatter: bool = option(False, help="whether it logs much")


class Camera(FakeSensor):
    frames = 0

    def read(self, timeout_s):
        self.frames += 1
        if self.frames > 200:
            raise SensorError("the camera was unplugged")
        time.sleep(0.002)
        return super().read(timeout_s)


class Dark(FakeSensor):
    def read(self, timeout_s):
        time.sleep(timeout_s)


class Lost(FakePolicy):
    def load(self):
        raise PolicyError("no such checkpoint: lost.pt")


@hookimpl
def ibrobot_hardware():
    yield HardwareDescriptor("logged", Arm, "an arm that logs", ArmOptions)


@hookimpl
def ibrobot_teleop():
    yield TeleopDescriptor("swing", Swing, "swings", SwingOptions)


@hookimpl
def ibrobot_sensors():
    yield SensorDescriptor("brittle", lambda options, ctx: Camera(ctx), "breaks")
    yield SensorDescriptor("dark", lambda options, ctx: Dark(ctx), "gives nothing")


@hookimpl
def ibrobot_policies():
    yield PolicyDescriptor("lost", lambda options, ctx: Lost(ctx), "is not there")

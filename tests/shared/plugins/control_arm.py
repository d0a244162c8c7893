"""An arm in a control process of its own."""

from __future__ import annotations

import os
import time
from pathlib import Path

import attrs
from ibrobot_testing.fakes import FakeHardware, FakeTrajectoryExecutor

from ibrobot_core import hookimpl
from ibrobot_core.api import Options
from ibrobot_core.descriptors import ExecutorDescriptor, HardwareDescriptor
from ibrobot_core.errors import HardwareError
from ibrobot_core.interfaces.hardware import Holding
from ibrobot_core.options import option


class Arm(FakeHardware):
    def __init__(self, options, ctx):
        super().__init__(ctx)
        self.options = options

    def connect(self):
        if self.options.trouble == "connect":
            raise HardwareError("servo 3 does not answer: check its cable")
        super().connect()
        if self.options.fork and os.fork() == 0:
            time.sleep(60)
            os._exit(0)

    def read(self):
        if self.options.trouble == "read":
            raise HardwareError("servo 3 does not answer: check its cable")
        return super().read()

    def reset_faults(self):
        if self.options.resetting:
            Path(self.options.resetting).touch()
            while Path(self.options.resetting).exists():
                time.sleep(0.001)

    def holding(self):
        return Holding("/dev/ttyARM", "arm torque off") if self.options.holds and not self.relaxed else None

    def disconnect(self):
        super().disconnect()
        if self.options.trouble == "disconnect":
            time.sleep(60)
        if self.options.closed:
            open(self.options.closed, "w").close()


@attrs.frozen
class GivenOptions(Options):
    trouble: str = option("", help="when it fails")
    closed: str = option("", help="file made when it is released")
    fork: bool = option(False, help="whether a process forked by it outlives it")
    resetting: str = option("", help="file made when it begins to clear faults, which takes until the file is removed")
    holds: bool = option(False, help="whether it has torque")


@hookimpl
def ibrobot_hardware():
    yield HardwareDescriptor("arm", Arm, "an arm", GivenOptions, simulated=True)


@hookimpl
def ibrobot_executors():
    yield ExecutorDescriptor("waypoints", lambda options, ctx: FakeTrajectoryExecutor(ctx), "along straight lines")

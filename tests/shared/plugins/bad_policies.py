# mypy: disable-error-code="operator,index"
"""Policies that break instead of acting badly, in a scene that is won by reaching a place."""

from __future__ import annotations

import os
import random
import signal
import time
from typing import override

import attrs
import numpy as np
from ibrobot_testing.fakes import FakeHardware, FakePolicy, FakeSensor

from ibrobot_core import hookimpl
from ibrobot_core.api import Options
from ibrobot_core.descriptors import HardwareDescriptor, PolicyDescriptor, SensorDescriptor
from ibrobot_core.options import option


class Reach(FakeHardware):
    """A success when the first joint is beyond 0.45 rad."""

    @override
    def success(self):
        return bool(self._position[0] > 0.45)


@attrs.frozen(kw_only=True)
class BadOptions(Options):
    """What is wrong with the policy."""

    how: str = option(
        choices=("good", "poor", "raise", "nan", "hang", "stop", "exit", "kill", "moody"), help="what it does"
    )
    every: int = option(1, ge=1, help="in the episodes whose seed divides by this")
    requests: int = option(1, ge=1, help="in each request whose number divides by this")


class Bad(FakePolicy):
    """Reaches the place, unless it is in the mood for something else."""

    def __init__(self, options, ctx):
        super().__init__(ctx)
        self._options, self._request, self._due = options, 0, False

    @override
    def reset(self, seed):
        self._goal = np.full(self.spec.action_size, 0.6)
        self._due, self._request = seed % self._options.every == 0, 0

    @override
    def infer(self, tensors):
        how = self._options.how
        self._request += 1
        if not self._due or self._request % self._options.requests:
            return super().infer(tensors)
        if how == "raise":
            raise RuntimeError("shapes (7,) and (6,) do not match")
        if how == "hang":
            while True:
                time.sleep(1.0)
        if how == "stop":
            os.kill(os.getpid(), signal.SIGSTOP)
        if how == "exit":
            os._exit(3)
        if how == "kill":
            os.kill(os.getpid(), signal.SIGSEGV)
        answer = super().infer(tensors)
        if how == "nan":
            answer["delta"] = answer["delta"] * np.nan
        if how == "poor":
            answer["delta"] = answer["delta"] * 0.0
        if how == "moody":
            answer["delta"] = answer["delta"] * random.SystemRandom().choice([0.0, 0.2, 0.4, 1.0])
        return answer


@hookimpl
def ibrobot_hardware():
    film = {"type": "eye"}
    yield HardwareDescriptor(
        "reach", lambda _, ctx: Reach(ctx), "a scene", simulated=True, sensors={"camera": "eye"}, film=film
    )


@hookimpl
def ibrobot_sensors():
    yield SensorDescriptor("eye", lambda _, ctx: FakeSensor(ctx), "a camera in the scene")


@hookimpl
def ibrobot_policies():
    yield PolicyDescriptor("bad", Bad, "a policy that breaks", BadOptions)

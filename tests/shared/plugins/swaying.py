"""An arm without an end, and a policy that sways its joints, takes 60 ms a request, and numbers its requests."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any, override

import attrs
import numpy as np
from ibrobot_testing.fakes import FakeHardware, FakePolicy

from ibrobot_core.api import Context, Frame, HardwareDescriptor, PolicyDescriptor, Tensors, Vector, hookimpl

CHUNK = 12
MADE: list[Sways] = []
"""Those of this process."""


class Endless(FakeHardware):
    """Has no success."""

    @override
    def success(self) -> bool:
        return False


class Sways(FakePolicy):
    """Sways all joints."""

    def __init__(self, options: Any, ctx: Context) -> None:
        super().__init__(ctx)
        self.spec = attrs.evolve(self.spec, chunk_size=CHUNK)
        self.asked = 0
        self.answered: list[int] = []
        MADE.append(self)

    @override
    def preprocess(self, frame: Frame) -> Tensors:
        self.asked += 1
        times = frame.stamp_ns / 1e9 + np.arange(CHUNK) / 30
        return {"phase": np.fmod(times, 2.0) * np.pi, "number": np.array([self.asked])}

    @override
    def infer(self, tensors: Tensors) -> Tensors:
        time.sleep(0.06)
        return {"at": 0.4 * np.sin(tensors["phase"]), "number": tensors["number"]}

    @override
    def postprocess(self, tensors: Tensors) -> Vector:
        self.answered.append(int(tensors["number"][0]))
        return np.repeat(tensors["at"][:, None], self.spec.action_size, axis=1)


@hookimpl
def ibrobot_hardware() -> Iterator[HardwareDescriptor]:
    yield HardwareDescriptor("endless", lambda options, ctx: Endless(ctx), "an arm", simulated=True)


@hookimpl
def ibrobot_policies() -> Iterator[PolicyDescriptor]:
    yield PolicyDescriptor("sways", Sways, "sways")

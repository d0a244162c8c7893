"""A policy of a test, which answers what the test has put into `answers`, and a base."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from ibrobot_testing.fakes import FakeHardware

from ibrobot_core.api import (
    Context,
    Frame,
    HardwareDescriptor,
    Policy,
    PolicyDescriptor,
    PolicyError,
    PolicySpec,
    Tensors,
    Vector,
    hookimpl,
)

answers: list[Vector] = []
"""The chunks [rad], shape (N, J), of which each request gets the next one, and none once there is no other."""


class Far(Policy):
    def __init__(self, options: Any, ctx: Context) -> None:
        joints = ctx.robot.joint_names
        self.spec = PolicySpec({"observation.state": (len(joints),)}, joints, len(joints), chunk_size=30)

    def preprocess(self, frame: Frame) -> Tensors:
        return {"stamp": np.array([frame.stamp_ns])}

    def infer(self, tensors: Tensors) -> Tensors:
        return tensors

    def postprocess(self, tensors: Tensors) -> Vector:
        if not answers:
            raise PolicyError("there is no further answer")
        return answers.pop(0)


@hookimpl
def ibrobot_policies() -> Iterator[PolicyDescriptor]:
    yield PolicyDescriptor("far", Far, "answers what a test wants")


@hookimpl
def ibrobot_hardware() -> Iterator[HardwareDescriptor]:
    yield HardwareDescriptor("wheels", lambda options, ctx: FakeHardware(ctx), "a base", simulated=True)

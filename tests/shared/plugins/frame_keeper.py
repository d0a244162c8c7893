"""A policy that keeps the frames that it gets."""

from __future__ import annotations

from typing import Any

import numpy as np

from ibrobot_core.descriptors import PolicyDescriptor
from ibrobot_core.hookspecs import hookimpl
from ibrobot_core.interfaces import Policy, PolicySpec

KEPT: list[dict[str, Any]] = []


class Keeper(Policy):
    """Keeps every frame that it is given, and moves the arm a little."""

    def __init__(self, options, ctx):
        image = (240, 320, 3)
        keys = {"observation.state": (6,), "observation.images.top": image, "observation.images.wrist": image}
        self.spec = PolicySpec(keys, None, 6, 1)

    def preprocess(self, frame):
        KEPT.append(frame)
        return {"state": frame.values["observation.state"]}

    def infer(self, tensors):
        return tensors

    def postprocess(self, tensors):
        return tensors["state"][None].astype(np.float64) + 0.02


@hookimpl
def ibrobot_policies():
    yield PolicyDescriptor(type="keeper", make=Keeper, summary="keeps frames")

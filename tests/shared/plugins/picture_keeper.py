"""A policy that keeps the frames that it gets, of a robot with two joints and a camera."""

from __future__ import annotations

from typing import Any

import numpy as np

from ibrobot_core.descriptors import PolicyDescriptor
from ibrobot_core.hookspecs import hookimpl
from ibrobot_core.interfaces import Policy, PolicySpec

KEPT: list[dict[str, Any]] = []


class PictureKeeper(Policy):
    """Keeps every frame that it is given, and moves two joints a little."""

    def __init__(self, options, ctx):
        self.spec = PolicySpec({"observation.state": (2,), "observation.images.top": (-1, -1, 3)}, None, 2, 1)

    def preprocess(self, frame):
        KEPT.append(frame)
        return {"state": frame.values["observation.state"]}

    def infer(self, tensors):
        return tensors

    def postprocess(self, tensors):
        return tensors["state"][None].astype(np.float64) + 0.01


@hookimpl
def ibrobot_policies():
    yield PolicyDescriptor(type="picture_keeper", make=PictureKeeper, summary="keeps frames with a picture")

"""Policies that keep the frames that they get, of robots with other observations."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from ibrobot_core.descriptors import PolicyDescriptor
from ibrobot_core.hookspecs import hookimpl
from ibrobot_core.interfaces import Policy, PolicySpec

KEPT: list[dict[str, Any]] = []


class Keeper(Policy):
    """Keeps every frame that it is given, and moves the arm a little."""

    shapes: ClassVar[dict[str, tuple[int, ...]]] = {
        "observation.state": (6,),
        "observation.images.top": (240, 320, 3),
        "observation.images.wrist": (240, 320, 3),
    }

    def __init__(self, options, ctx):
        self.spec = PolicySpec(self.shapes, None, self.shapes["observation.state"][0], 1)

    def preprocess(self, frame):
        KEPT.append(frame)
        return {"state": frame.values["observation.state"]}

    def infer(self, tensors):
        return tensors

    def postprocess(self, tensors):
        return tensors["state"][None].astype(np.float64) + 0.02


class PictureKeeper(Keeper):
    """Of a robot with two joints and a camera."""

    shapes: ClassVar[dict[str, tuple[int, ...]]] = {"observation.state": (2,), "observation.images.top": (-1, -1, 3)}


class ForceKeeper(Keeper):
    """Of a robot with two joints and a force sensor."""

    shapes: ClassVar[dict[str, tuple[int, ...]]] = {"observation.state": (2,), "observation.force": (6,)}


@hookimpl
def ibrobot_policies():
    yield PolicyDescriptor(type="keeper", make=Keeper, summary="keeps frames")
    yield PolicyDescriptor(type="picture_keeper", make=PictureKeeper, summary="keeps frames with a picture")
    yield PolicyDescriptor(type="force_keeper", make=ForceKeeper, summary="keeps frames with forces")

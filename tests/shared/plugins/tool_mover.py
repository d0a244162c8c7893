"""A policy that moves the tool by poses, or joints by differences, and keeps what it sees."""

from __future__ import annotations

from typing import Any

import attrs
import numpy as np

from ibrobot_core.api import Options
from ibrobot_core.descriptors import PolicyDescriptor
from ibrobot_core.hookspecs import hookimpl
from ibrobot_core.interfaces import Policy, PolicySpec
from ibrobot_core.options import documented, option

KEPT: list[Any] = []
STEP = (0.001, 0.002, -0.001)
"""How far it moves the tool in a tick [m]."""


@documented
@attrs.frozen
class MoverOptions(Options):
    """Options of the policy."""

    chunk_size: int = option(1, help="number of actions")
    far: bool = option(False, help="whether every third answer is far beyond reach")
    deltas: bool = option(False, help="whether it gives differences of joints, without looking at the joints")


class Mover(Policy):
    """Keeps every frame, and answers with poses a little further on, or with 0.01 rad more for each joint."""

    def __init__(self, options, ctx):
        self._options = options
        size = 6 if options.deltas else 10
        self.spec = PolicySpec({"observation.tool": (10,)}, None, size, options.chunk_size)

    def preprocess(self, frame):
        KEPT.append(frame)
        return {"tool": frame.values["observation.tool"]}

    def infer(self, tensors):
        return tensors

    def postprocess(self, tensors):
        if self._options.deltas:
            return np.full((self._options.chunk_size, 6), 0.01)
        rows = np.tile(tensors["tool"].astype(np.float64), (self._options.chunk_size, 1))
        rows[:, :3] += np.arange(1, len(rows) + 1)[:, None] * STEP
        if self._options.far and len(KEPT) % 3 == 0:
            rows[:, 0] = 2.0
        return rows


@hookimpl
def ibrobot_policies():
    yield PolicyDescriptor(type="mover", options=MoverOptions, make=Mover, summary="moves the tool")

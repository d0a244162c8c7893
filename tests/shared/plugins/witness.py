"""An arm that notes in a shared file when it moved."""

from __future__ import annotations

import mmap
import struct
import time
from collections.abc import Iterator
from pathlib import Path
from typing import override

import attrs
import numpy as np

from ibrobot_core.api import Context, Hardware, HardwareDescriptor, JointReading, Options, Vector, hookimpl, option


@attrs.frozen
class WitnessOptions(Options):
    file: Path = option(help="shared file")


class Witness(Hardware):
    """Follows at once; in the file is when it was last moved, and when last commanded, by the monotonic clock [ns]."""

    def __init__(self, options: WitnessOptions, ctx: Context) -> None:
        self.joints, self._clock, self._file = ctx.joints, ctx.clock, options.file
        self._at, self._zero = np.zeros(len(ctx.joints)), np.zeros(len(ctx.joints))
        self._moved = 0

    @override
    def connect(self) -> None:
        with self._file.open("r+b") as file:
            self._shared = mmap.mmap(file.fileno(), 4096)

    @override
    def read(self) -> JointReading:
        return JointReading(self._clock.now_ns(), self._at.copy(), self._zero, self._zero)

    @override
    def write(self, position: Vector) -> None:
        now = time.monotonic_ns()
        if np.abs(position - self._at).max() > 1e-6:
            self._moved = now
        self._at[:] = position
        struct.pack_into("<qq", self._shared, 0, self._moved, now)

    @override
    def disconnect(self) -> None:
        pass


@hookimpl
def ibrobot_hardware() -> Iterator[HardwareDescriptor]:
    yield HardwareDescriptor(type="witness", options=WitnessOptions, make=Witness, summary="notes when it moves")

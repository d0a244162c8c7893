"""A teleoperation device without an operator: it waves with one joint."""

import math
from collections.abc import Iterable
from typing import override

import attrs

from ibrobot_core.api import (
    Context,
    JointReading,
    Options,
    Teleop,
    TeleopCommand,
    TeleopDescriptor,
    TeleopError,
    hookimpl,
    option,
    seconds,
)


@attrs.frozen
class WaveOptions(Options):
    """What the YAML may say."""

    joint: str = option("wrist_flex", help="the joint that waves")
    amplitude: float = option(0.3, unit="rad", gt=0, le=1, help="how far to each side")
    period: float = option(2.0, unit="s", ge=0.5, help="time from wave to wave")


class Wave(Teleop):
    """What it does: a sine around the position at which it was activated."""

    operated = False  # it moves by itself

    def __init__(self, options: WaveOptions, ctx: Context) -> None:
        self._options = options
        self._index = int(ctx.robot.indices([options.joint])[0])
        self._connected = False
        self._centre = 0.0
        self._start_ns: int | None = None

    @override
    def connect(self) -> None:
        self._connected = True

    @override
    def disconnect(self) -> None:
        self._connected = False

    @override
    def activate(self, measured: JointReading) -> None:
        self._centre = float(measured.position[self._index])
        self._start_ns = None

    @override
    def read(self, measured: JointReading) -> TeleopCommand:
        if not self._connected:
            raise TeleopError("the wave is not connected")
        if self._start_ns is None:
            self._start_ns = measured.stamp_ns
        phase = 2 * math.pi * seconds(measured.stamp_ns - self._start_ns) / self._options.period
        return TeleopCommand({self._options.joint: self._centre + self._options.amplitude * math.sin(phase)})


@hookimpl
def ibrobot_teleop() -> Iterable[TeleopDescriptor]:
    """What this package offers."""
    yield TeleopDescriptor(type="wave", options=WaveOptions, make=Wave, summary="waves with one joint")

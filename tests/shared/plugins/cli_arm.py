"""An arm for tests of the command line, its camera and a command."""

from __future__ import annotations

from typing import Never

import attrs

from ibrobot_core import hookimpl
from ibrobot_core.api import Options
from ibrobot_core.descriptors import Command, HardwareDescriptor, SensorDescriptor
from ibrobot_core.errors import HardwareError
from ibrobot_core.options import option


@attrs.frozen
class Servo:
    id: int = option(help="number on the bus")


@attrs.frozen
class GivenOptions(Options):
    port: str = option(help="serial port")
    max_speed: float = option(3.0, unit="rad/s", gt=0, le=6.5, help="speed limit of the servos")
    mode: str = option("soft", choices=("soft", "hard"), help="how it holds")
    servos: tuple[Servo, ...] = option((), help="what differs from the default")
    offset: float | None = option(None, unit="rad", help="of the base")


def unused(options: object, ctx: object) -> Never:
    raise NotImplementedError("nothing makes one")


@hookimpl
def ibrobot_hardware():
    yield HardwareDescriptor("fake_arm", unused, "an arm of thin air", GivenOptions)


@hookimpl
def ibrobot_sensors():
    yield SensorDescriptor("fake_arm", unused, "the camera in its hand")


@attrs.frozen
class Greet:
    """Say hello."""

    def __call__(self):
        raise HardwareError("nobody there")


@hookimpl
def ibrobot_commands():
    yield Command("greet", Greet)

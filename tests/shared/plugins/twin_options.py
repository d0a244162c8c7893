"""A plugin with two kinds of the same name and the same options."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import attrs

from ibrobot_core.api import Options, SensorDescriptor, TeleopDescriptor, hookimpl, option


@attrs.frozen
class TwinOptions(Options):
    """What both of them need."""

    port: str = option(help="serial port")


def _make(options: Any, ctx: Any) -> Any:
    raise NotImplementedError


@hookimpl
def ibrobot_sensors() -> Iterator[SensorDescriptor]:
    """The camera."""
    yield SensorDescriptor("twin", _make, "a camera", options=TwinOptions)


@hookimpl
def ibrobot_teleop() -> Iterator[TeleopDescriptor]:
    """The leader."""
    yield TeleopDescriptor("twin", _make, "a leader", options=TwinOptions)

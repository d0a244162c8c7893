"""A plugin that works."""

from __future__ import annotations

from pathlib import Path
from typing import Never

import attrs

from ibrobot_core import hookimpl
from ibrobot_core.api import Options
from ibrobot_core.descriptors import Check, ConfigFile, HardwareDescriptor
from ibrobot_core.options import option


@attrs.frozen
class GivenOptions(Options):
    port: str = option(help="serial port")


def unused(options: object, ctx: object) -> Never:
    raise NotImplementedError("nothing makes one")


@hookimpl
def ibrobot_hardware():
    yield HardwareDescriptor("good_arm", unused, "an arm that works", GivenOptions)


@hookimpl
def ibrobot_configs():
    yield ConfigFile("good", Path("good.yaml"))


@hookimpl
def ibrobot_doctor():
    yield Check("good arm", True, "present")


@hookimpl
def ibrobot_mode_changed(mode):
    events.append(mode)


events: list[str] = []

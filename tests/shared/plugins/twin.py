"""A plugin that offers the type of another one."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Never

import attrs

from ibrobot_core import hookimpl
from ibrobot_core.api import Options
from ibrobot_core.descriptors import ConfigFile, HardwareDescriptor


@attrs.frozen
class GivenOptions(Options):
    """No options."""


def unused(options: object, ctx: object) -> Never:
    raise NotImplementedError("nothing makes one")


@hookimpl
def ibrobot_hardware() -> Iterator[HardwareDescriptor]:
    yield HardwareDescriptor("good_arm", unused, "another of that name", GivenOptions)


@hookimpl
def ibrobot_configs() -> Iterator[ConfigFile]:
    yield ConfigFile("other", Path("good.yaml"))

"""A plugin with a default recorder, whose type is the module's name, and another one."""

from __future__ import annotations

from typing import Never

from ibrobot_core import hookimpl
from ibrobot_core.descriptors import RecorderDescriptor


def unused(options: object, ctx: object) -> Never:
    raise NotImplementedError("nothing makes one")


@hookimpl
def ibrobot_recorders():
    yield RecorderDescriptor(f"{__name__}_tape", unused, "a tape")
    yield RecorderDescriptor(__name__, unused, "a disk", default=True)

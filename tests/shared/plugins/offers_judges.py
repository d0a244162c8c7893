"""A plugin that offers a type of a kind that another one defines, and hardware."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Never

from ibrobot_core import hookimpl
from ibrobot_core.descriptors import Descriptor, HardwareDescriptor


def unused(options: object, ctx: object) -> Never:
    raise NotImplementedError("nothing makes one")


@hookimpl
def ibrobot_hardware() -> Iterator[HardwareDescriptor]:
    yield HardwareDescriptor("plain_arm", unused, "an arm")


@hookimpl(optionalhook=True)
def ibrobot_judges() -> Iterator[Descriptor[Any]]:
    from fake_defining import JudgeDescriptor  # type: ignore[import-not-found]

    yield JudgeDescriptor("strict", unused, "never pleased")

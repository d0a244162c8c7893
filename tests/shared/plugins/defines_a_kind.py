"""A plugin that defines a kind."""

from __future__ import annotations

from collections.abc import Iterator

import attrs

from ibrobot_core import hookimpl
from ibrobot_core.descriptors import Descriptor, Kind


@attrs.frozen
class JudgeDescriptor(Descriptor[object]):
    """A judge."""


@hookimpl
def ibrobot_kinds() -> Iterator[Kind]:
    yield Kind("judge", "ibrobot_judges", JudgeDescriptor)

"""A plugin whose decoder and whose check of its section raise what no caller expects."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NoReturn

from ibrobot_core import hookimpl
from ibrobot_core.descriptors import DecoderDescriptor, SectionDescriptor
from ibrobot_core.options import OptionFault

RAISED: BaseException = SystemExit("not today")
"""What they raise; a test sets it."""


def make(*arguments: object) -> NoReturn:
    """Raise it at once."""
    raise RAISED


def check(config: object) -> Iterator[OptionFault]:
    """Raise it while its faults are read."""
    yield from ()
    raise RAISED


@hookimpl
def ibrobot_decoders() -> Iterator[DecoderDescriptor]:
    yield DecoderDescriptor(("odd",), make)


@hookimpl
def ibrobot_sections() -> Iterator[SectionDescriptor]:
    yield SectionDescriptor("odd", make=make, summary="an odd section", check_config=check)

"""A plugin whose functions raise when they are asked whether a file or a robot is theirs."""

from __future__ import annotations

from collections.abc import Iterator

from ibrobot_core import hookimpl
from ibrobot_core.descriptors import Command, PolicyDescriptor, ReaderDescriptor, SectionDescriptor


def no(*arguments: object) -> bool:
    """Raise what no caller expects."""
    raise SystemExit("not today")


@hookimpl
def ibrobot_readers() -> Iterator[ReaderDescriptor]:
    yield ReaderDescriptor("odd", "odd files", no, no)  # type: ignore[arg-type]


@hookimpl
def ibrobot_commands() -> Iterator[Command]:
    yield Command("odd", summary="does odd things", takes=no)  # type: ignore[arg-type]


@hookimpl
def ibrobot_policies() -> Iterator[PolicyDescriptor]:
    yield PolicyDescriptor("odd", no, "an odd policy", reads=no)  # type: ignore[arg-type]


@hookimpl
def ibrobot_sections() -> Iterator[SectionDescriptor]:
    yield SectionDescriptor("odd", make=no, summary="an odd section", without_section=no)  # type: ignore[arg-type]

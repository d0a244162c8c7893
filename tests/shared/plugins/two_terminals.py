"""A plugin with two terminals, both of which are a default."""

from __future__ import annotations

from ibrobot_testing.fakes.run import FakeTerminal

from ibrobot_core import hookimpl
from ibrobot_core.descriptors import Descriptor


class QuietTerminal(FakeTerminal):
    """The other one."""


@hookimpl
def ibrobot_terminals():
    for type_, make in (("printing", FakeTerminal), ("quiet", QuietTerminal)):
        yield Descriptor(type_, make=lambda options, ctx, make=make: make(), summary=type_, default=True)

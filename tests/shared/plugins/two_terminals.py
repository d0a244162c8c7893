"""A plugin with two terminals, both of which are a default."""

from __future__ import annotations

from ibrobot_testing.fakes.run import FakeTerminal

from ibrobot_core import hookimpl
from ibrobot_core.descriptors import Descriptor


class QuietTerminal(FakeTerminal):
    """The other one."""


@hookimpl
def ibrobot_terminals():
    yield Descriptor("printing", make=lambda options, ctx: FakeTerminal(), summary="prints", default=True)
    yield Descriptor("quiet", make=lambda options, ctx: QuietTerminal(), summary="quiet", default=True)

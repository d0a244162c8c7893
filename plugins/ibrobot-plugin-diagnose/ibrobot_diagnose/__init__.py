"""The plugin's hooks: the command `ibrobot explain`.

Causes are classes; those of other packages are entry points of the group `ibrobot_causes`, see `cause`.
"""

from __future__ import annotations

from collections.abc import Iterable

from ibrobot_core.api import Late, hookimpl
from ibrobot_core.app import Command
from ibrobot_diagnose.options import EVENTS


@hookimpl
def ibrobot_commands() -> Iterable[Command]:
    """`ibrobot explain`."""
    summary = "Say why a recorded run of a policy failed."
    yield Command("explain", Late("ibrobot_diagnose.commands:Explain"), summary, EVENTS)

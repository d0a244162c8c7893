"""The hook: the terminal of runs."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from ibrobot_core.api import Descriptor, Late, hookimpl


@hookimpl
def ibrobot_terminals() -> Iterable[Descriptor[Any]]:
    """Keys and panel."""
    yield Descriptor(
        type="panel",
        make=lambda options, ctx: Late("ibrobot_terminal.run_terminal:PanelTerminal")(),
        summary="reads the terminal's keys, and shows a live panel",
        default=True,
    )

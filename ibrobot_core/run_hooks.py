"""The keys of every run, and hooks for the keys and status rows that a command adds to them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

RUN_KEYS: Mapping[str, str] = {
    "esc": "emergency stop",
    "tab": "start and end of an episode",
    **{f"f{i}": "mode switch" for i in range(1, 10)},
    "f10": "reset",
    "backspace": "redo of an episode",
    "f11": "end of an episode",
    "f12": "end of an episode",
}
"""Key -> its meaning in every run; devices and sections may only use it for the same."""


class RunHooks:
    """A command's additions to a run. The base class adds nothing."""

    def step(self) -> None:
        """Do periodic work; called a few times per second, and in lockstep at every tick."""

    def key(self, key: str) -> bool:
        """Handle a key; return False for an unknown key."""
        return False

    def rows(self) -> list[tuple[str, str]]:
        """Rows for the panel: heading and text."""
        return []

    def line(self) -> str:
        """Text for a plain status line."""
        return ""

    def help(self) -> str:
        """Help on the keys, for the panel."""
        return ""

    def summary_rows(self) -> list[tuple[str, str]]:
        """Rows for the summary of the run: heading and text."""
        return []

    def facts(self) -> dict[str, Any]:
        """Facts for the summary as JSON."""
        return {}

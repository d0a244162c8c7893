"""Hooks for a command's own keys and status rows, beside those of the run and its mode."""

from __future__ import annotations

from typing import Any


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

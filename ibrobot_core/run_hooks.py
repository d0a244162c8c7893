"""Hooks for a command's own keys and status rows, beside those of the run and its mode."""

from __future__ import annotations


class RunHooks:
    """What a command adds to a run. This one adds nothing."""

    def step(self) -> None:
        """Do what is due; called a few times a second, and in lockstep at every tick."""

    def key(self, key: str) -> bool:
        """Act on a key; False for one that has no meaning here."""
        return False

    def rows(self) -> list[tuple[str, str]]:
        """Heading and text, for the panel."""
        return []

    def line(self) -> str:
        """For a plain line of status."""
        return ""

    def help(self) -> str:
        """The keys, for the panel."""
        return ""

    def summary_rows(self) -> list[tuple[str, str]]:
        """Heading and text, for the summary of the run."""
        return []

"""The names of keys, the keys of every run, and hooks for the keys and status rows that a command adds to them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

KEY_NAMES = (
    "space", "enter", "tab", "backspace", "esc", "up", "down", "right", "left", "home", "end",
    *(f"f{i}" for i in range(1, 13)), "insert", "delete", "page_up", "page_down",
)  # fmt: skip
"""The keys with a name; every other key is the character that it types."""
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


def check_key(key: str) -> None:
    """Check the name of a key.

    Raises:
        ValueError: if no key has it.
    """
    if key not in KEY_NAMES and not (len(key) == 1 and key.isprintable() and key != " "):
        raise ValueError(f"{key!r} is not a key: give the character that it types, or a name: {', '.join(KEY_NAMES)}")


class Told:
    """What a part of a run tells the operator; the base class tells nothing."""

    def help(self) -> str:
        """Instructions for the operator: for a source, in its mode; for hooks, on their keys."""
        return ""

    def summary_rows(self) -> list[tuple[str, str]]:
        """Rows for the summary of the run: heading and text."""
        return []

    def facts(self) -> dict[str, Any]:
        """Facts for the summary as JSON."""
        return {}


class RunHooks(Told):
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

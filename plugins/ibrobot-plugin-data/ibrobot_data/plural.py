"""Words of the commands' messages."""

from __future__ import annotations


def plural(number: int, noun: str) -> str:
    """The noun after a number: `1 episode`, `2 episodes`."""
    return noun if number == 1 else f"{noun}s"

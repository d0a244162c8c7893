"""Plurals in messages."""

from __future__ import annotations


def plural(number: int, noun: str) -> str:
    """Inflect a noun by a number: `episode` for 1, `episodes` for others."""
    return noun if number == 1 else f"{noun}s"


def counted(number: int, noun: str) -> str:
    """A number with what it counts: `1 episode`, `2 episodes`."""
    return f"{number} {plural(number, noun)}"

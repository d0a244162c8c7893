"""Plurals in messages."""

from __future__ import annotations


def plural(number: int, noun: str) -> str:
    """Inflect a noun by a number: `1 episode`, `2 episodes`."""
    return noun if number == 1 else f"{noun}s"

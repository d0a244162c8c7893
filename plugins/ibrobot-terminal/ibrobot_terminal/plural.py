"""Plurals in messages."""

from __future__ import annotations


def plural(number: int, noun: str) -> str:
    """Inflect a noun by a number: `episode` for 1, `episodes` for others."""
    return noun if number == 1 else f"{noun}s"


def counted(number: int, noun: str) -> str:
    """A number with what it counts: `1 episode`, `2 episodes`."""
    return f"{number} {plural(number, noun)}"


def measured(value: float, unit: str) -> str:
    """A value in three digits with its unit: `1 difference`, `2 differences`, `1 ms`, `0.5 rad/s`."""
    shown = f"{value:.3g}"
    return f"{shown} {unit[:-1] if shown == '1' and unit.isalpha() and unit.endswith('s') and len(unit) > 2 else unit}"

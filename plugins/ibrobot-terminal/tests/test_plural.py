"""Plurals in messages."""

from __future__ import annotations

import pytest
from ibrobot_terminal.plural import counted, measured, plural


@pytest.mark.parametrize(
    ("number", "noun", "text"),
    [
        (0, "episode", "0 episodes"),
        (1, "episode", "1 episode"),
        (2, "episode", "2 episodes"),
        (11, "joint", "11 joints"),
    ],
)
def test_a_number_inflects_what_it_counts(number: int, noun: str, text: str) -> None:
    assert counted(number, noun) == text
    assert text.endswith(f" {plural(number, noun)}")


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (1.0, "differences", "1 difference"), (1.0004, "times", "1 time"), (1.2, "times", "1.2 times"),
        (0.0, "cameras", "0 cameras"), (1.0, "ms", "1 ms"), (1.0, "pictures/s", "1 pictures/s"), (1.0, "px", "1 px"),
    ],
)  # fmt: skip
def test_a_unit_that_is_a_word_is_inflected(value: float, unit: str, text: str) -> None:
    assert measured(value, unit) == text

"""Fields common to reports of many makes."""

from __future__ import annotations

_HAT = ((0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1), (-1, 0), (-1, 1))
"""Right and up, clockwise from up: the order of the hat switch in the HID usage tables (1.5, section 4.3)."""


def hat(value: int) -> tuple[int, int]:
    """Right and up of a hat switch that counts from 0; (0, 0) for any other value, its rest."""
    return _HAT[value] if 0 <= value < len(_HAT) else (0, 0)


def byte_axis(value: int) -> float:
    """A stick's byte, 0 to 255 with its rest at 127 or 128, as -1 to 1; both are 0."""
    return 0.0 if value in (127, 128) else (value - 127.5) / 127.5


def word_axis(value: int) -> float:
    """A stick's 16 bits, 0 to 65535 with its rest at 32768, as -1 to 1."""
    return (value - 32768) / 32768


def bits(value: int, names: tuple[str, ...]) -> list[tuple[str, int]]:
    """The bits of a field from the lowest on; an empty name leaves one out."""
    return [(name, value >> i & 1) for i, name in enumerate(names) if name]

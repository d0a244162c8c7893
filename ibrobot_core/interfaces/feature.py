"""Columns of datasets and of contracts."""

from __future__ import annotations

import attrs


@attrs.frozen
class Feature:
    """A column of a dataset, with LeRobot's fields."""

    dtype: str
    """`float32`, `image`, …"""
    shape: tuple[int, ...]
    names: tuple[str, ...] = ()

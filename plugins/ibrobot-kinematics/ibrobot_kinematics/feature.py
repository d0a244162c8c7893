"""What every feature of an action can do: joints to numbers, and back."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

from ibrobot_core.api import Vector


class ActionFeature(ABC):
    """Numbers in place of the positions of an executor's joints."""

    names: tuple[str, ...]
    """One for each number."""
    reference: tuple[str, ...] = ()
    """The joints whose measured positions the numbers are relative to."""
    in_units: ClassVar[bool] = False
    """Whether positions are in the units of the dataset, e.g. degrees; otherwise in radians."""

    @abstractmethod
    def encode(self, positions: Vector, measured: Vector) -> Vector:
        """The numbers, shape (…, N).

        Args:
            positions: those that the executor's joints are commanded, shape (…, J).
            measured: those of `reference`, shape (R,).
        """

    @abstractmethod
    def decode(self, numbers: Vector, measured: Vector, start: Vector) -> tuple[Vector, int]:
        """The positions that numbers ask for, shape (M, J), and how many of them no position reaches.

        For those, the position before is repeated.

        Args:
            numbers: shape (M, N).
            measured: the positions of `reference`, shape (R,).
            start: the positions commanded before them, shape (J,).
        """

"""Interface of an expert for one scene: plans from the scene's ground truth."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

import attrs

from ibrobot_core.api import Vector
from ibrobot_mujoco.experts.options import ExpertOptions
from ibrobot_mujoco.experts.way import Hand, Way


@attrs.frozen(eq=False)
class Task(ABC):
    """Plans for one hand, or for the left and the right one."""

    hands: tuple[Hand, ...]
    options: ExpertOptions

    sides: ClassVar[tuple[str, ...]] = ("",)
    """Prefixes of the joint groups of the hands."""

    @property
    def hand(self) -> Hand:
        """The only or first hand."""
        return self.hands[0]

    @abstractmethod
    def plan(self, way: Way, scene: Vector, home: Vector) -> None:
        """Plan the task: extend a way to `home`, shape (J,) [rad].

        Raises:
            UnreachableError: if an object is out of reach.
        """

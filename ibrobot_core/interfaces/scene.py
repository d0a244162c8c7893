"""Scenes: the objects around a simulated robot, how an episode arranges them, and when its task is done."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

from ibrobot_core.robot import Vector


class Scene[Spec, World](ABC):
    """The objects and the task of a simulation. Core knows neither `Spec` nor `World`: the simulation defines them.

    Attributes:
        values: names of the values that `observe` writes, e.g. `cube.x`.
        factors: names of the values that `begin` draws, e.g. `cube_x`, `light`; results are compared by them.
        poses: body that moves -> index of its pose in `values`: position [m] (3), quaternion wxyz (4).
    """

    values: tuple[str, ...] = ()
    factors: tuple[str, ...] = ()
    poses: Mapping[str, int] = MappingProxyType({})

    @abstractmethod
    def build(self, spec: Spec) -> None:
        """Add the objects to the description of the simulated world, once."""

    @abstractmethod
    def begin(self, world: World, rng: np.random.Generator) -> Vector:
        """Arrange the objects for an episode, at rest and clear of the robot; equal generators give equal episodes.

        A factor that the options fix leaves those that others draw from equal generators unchanged.

        Returns:
            The values of `factors`, shape (F,), from which `show` derives all that does not move.

        Raises:
            HardwareError: if the options leave no place for an object.
        """

    @abstractmethod
    def show(self, world: World, factors: Vector) -> None:
        """Set sizes, colours, friction, lights and cameras to those of an episode with these factors, shape (F,)."""

    @abstractmethod
    def observe(self, world: World, out: Vector) -> None:
        """Write the ground truth into `out`, shape (V,)."""

    @abstractmethod
    def success(self, world: World) -> bool | None:
        """Whether the task is done; None for a scene without a task."""

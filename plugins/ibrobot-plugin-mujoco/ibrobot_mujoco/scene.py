"""Scenes: the objects around a simulated robot, how an episode arranges them, and when its task is done."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import attrs

from ibrobot_core.api import Descriptor, not_a_key
from ibrobot_core.app import ComponentConfig

if TYPE_CHECKING:
    import numpy as np

    from ibrobot_core.api import Robot, Vector


class Scene[Spec, World](ABC):
    """The objects and the task of a simulation. The simulation defines `Spec` and `World`.

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


@attrs.frozen
class SceneDescriptor(Descriptor[Scene[Any, Any]]):
    """A scene of a simulation, whose options have a field of type `SceneConfig`; the simulation makes it."""

    make: Callable[[Any, Robot], Scene[Any, Any]] = attrs.field(kw_only=True)  # type: ignore[assignment]
    """Options and robot -> the scene."""

    def kept(self) -> Mapping[str, Any]:
        """Itself, with which the simulation makes the scene."""
        return {"descriptor": self}


@attrs.frozen
class SceneConfig(ComponentConfig):
    """The scene in the options of a simulation."""

    plugin_kind = "scene"

    descriptor: SceneDescriptor = not_a_key()

    def make(self, robot: Robot) -> Scene[Any, Any]:
        """The scene, around a robot."""
        return self.descriptor.make(self.options, robot)

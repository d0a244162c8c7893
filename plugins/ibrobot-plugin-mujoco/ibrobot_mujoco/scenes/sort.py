"""Scene `sort`: red and blue cubes have to be put into the bins of their colours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import override

import mujoco
import numpy as np

from ibrobot_core.api import Robot, Vector
from ibrobot_mujoco.scenes.options import SortOptions
from ibrobot_mujoco.scenes.solids import BLUE, RED, add_bin, bin_centre, is_in_bin
from ibrobot_mujoco.scenes.table import TableScene
from ibrobot_mujoco.world import World

COLOURS = (RED, BLUE)
NAMES = ("red", "blue")


class Sort(TableScene[SortOptions]):
    """Observation: the poses of the cubes, the number of the bin of each (0 red, 1 blue), and the bins' centres."""

    def __init__(self, options: SortOptions, robot: Robot) -> None:
        self.moving = tuple(f"cube{i + 1}" for i in range(options.cubes))
        bins = (f"{name}_bin.{axis}" for name in NAMES for axis in "xyz")
        self.further = (*(f"{cube}.bin" for cube in self.moving), *bins)
        self.placed = tuple(f"{cube}_{value}" for cube in self.moving for value in ("x", "y", "yaw", "bin"))
        self.sizes = {"cube_size": self.moving}  # type: ignore[misc]
        super().__init__(options, robot)
        self._centres = np.stack([bin_centre(options.red_bin), bin_centre(options.blue_bin)])
        self._bins = np.zeros(options.cubes)

    @override
    def add(self, spec: mujoco.MjSpec) -> None:
        super().add(spec)
        for name, position, rgba in zip(NAMES, (self.options.red_bin, self.options.blue_bin), (RED, BLUE), strict=True):
            add_bin(spec, f"{name}_bin", position, rgba)

    @override
    def arrange(self, world: World, rng: np.random.Generator, look: Mapping[str, float]) -> Sequence[float]:
        factors: list[float] = []
        for cube, number in zip(self.moving, rng.integers(2, size=self.options.cubes), strict=True):
            factors += [*self.place_cube(world, cube, rng, look["cube_size"]), float(number)]
        return factors

    @override
    def show(self, world: World, factors: Vector) -> None:
        super().show(world, factors)
        self._bins = factors[3 : 4 * len(self.moving) : 4]
        for cube, number in zip(self.moving, self._bins, strict=True):
            world.model.geom(cube).rgba = COLOURS[int(number)]

    @override
    def observe(self, world: World, out: Vector) -> None:
        super().observe(world, out)
        first = 7 * len(self.moving)
        out[first:] = [*self._bins, *self._centres.ravel()]

    @override
    def success(self, world: World) -> bool:
        """Whether the robot has carried every cube, each lies in the bin of its colour, and the robot touches none."""
        return self.carried(world) == set(self.moving) and all(
            is_in_bin(world.pose(cube)[:3], self._centres[int(number)]) and self.at_rest(world, cube)
            for cube, number in zip(self.moving, self._bins, strict=True)
        )

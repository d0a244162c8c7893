"""Scene `pick_cube`: a cube has to be put into a bin."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, override

import mujoco
import numpy as np

from ibrobot_core.api import Robot, Vector
from ibrobot_mujoco.scenes.options import PickCubeOptions
from ibrobot_mujoco.scenes.solids import BLUE, add_bin, bin_centre, is_in_bin
from ibrobot_mujoco.scenes.table import TableScene
from ibrobot_mujoco.world import World

CUBE, BIN = "cube", "bin"


class PickCube(TableScene[PickCubeOptions]):
    """Observation: the cube's pose, then the centre of the bin [m] (3)."""

    moving = (CUBE,)
    further = ("bin.x", "bin.y", "bin.z")
    placed = ("cube_x", "cube_y", "cube_yaw")
    sizes: ClassVar = {"cube_size": (CUBE,)}
    colours: ClassVar = {"cube_colour": (CUBE,)}

    def __init__(self, options: PickCubeOptions, robot: Robot) -> None:
        super().__init__(options, robot)
        self._centre = bin_centre(options.bin_position)

    @override
    def add(self, spec: mujoco.MjSpec) -> None:
        super().add(spec)
        add_bin(spec, BIN, self.options.bin_position, BLUE)

    @override
    def arrange(self, world: World, rng: np.random.Generator, look: Mapping[str, float]) -> Sequence[float]:
        return self.place_cube(world, CUBE, rng, look["cube_size"])

    @override
    def observe(self, world: World, out: Vector) -> None:
        super().observe(world, out)
        out[7:] = self._centre

    @override
    def success(self, world: World) -> bool:
        """Whether the robot has carried the cube, it lies in the bin below the rim, and the robot does not touch it."""
        return (
            CUBE in self.carried(world) and is_in_bin(world.pose(CUBE)[:3], self._centre) and self.at_rest(world, CUBE)
        )

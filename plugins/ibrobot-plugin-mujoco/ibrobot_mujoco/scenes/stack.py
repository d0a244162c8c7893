"""Scene `stack`: a cube has to be put on another one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, override

import numpy as np

from ibrobot_mujoco.scenes.options import StackOptions
from ibrobot_mujoco.scenes.table import TableScene
from ibrobot_mujoco.world import World

CUBE, BASE = "cube", "base_cube"
_GAP = 0.004
"""Allowed difference between the cube's height and that of a cube that lies on the other [m]."""


class Stack(TableScene[StackOptions]):
    """Observation: the poses of the cube and of the one below."""

    moving = (CUBE, BASE)
    placed = ("cube_x", "cube_y", "cube_yaw", "base_x", "base_y", "base_yaw")
    sizes: ClassVar = {"cube_size": (CUBE,), "base_size": (BASE,)}
    colours: ClassVar = {"cube_colour": (CUBE,), "base_colour": (BASE,)}

    @override
    def arrange(self, world: World, rng: np.random.Generator, look: Mapping[str, float]) -> Sequence[float]:
        base = self.place_cube(world, BASE, rng, look["base_size"])
        return *self.place_cube(world, CUBE, rng, look["cube_size"]), *base

    @override
    def success(self, world: World) -> bool:
        """Whether the robot has carried the cube, it lies on the other one, both rest, untouched."""
        carried = CUBE in self.carried(world)
        cube, base = world.pose(CUBE)[:3], world.pose(BASE)[:3]
        sizes = [2 * float(world.model.geom(name).size[0]) for name in (CUBE, BASE)]
        over = float(np.hypot(*(cube - base)[:2])) < sizes[1] / 2
        lies = over and abs(cube[2] - sizes[1] - sizes[0] / 2) < _GAP
        return carried and bool(lies) and all(self.at_rest(world, body) for body in self.moving)

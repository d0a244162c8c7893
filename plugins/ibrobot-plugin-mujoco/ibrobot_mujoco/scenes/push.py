"""Scene `push`: a block has to be pushed onto a mark on the table."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import ClassVar, override

import mujoco
import numpy as np

from ibrobot_core.api import Vector
from ibrobot_mujoco.scenes.options import PushOptions
from ibrobot_mujoco.scenes.table import TableScene, height
from ibrobot_mujoco.world import World

BLOCK, GOAL = "block", "goal"
_LIFTED_M, _LIES_M = 0.003, 0.001
"""Height of the block's lowest corner above which it is lifted, and below which it lies on the table [m]."""


class Push(TableScene[PushOptions]):
    """Observation: the block's pose, then the goal [m] (3)."""

    moving = (BLOCK,)
    further = ("goal.x", "goal.y", "goal.z")
    placed = ("block_x", "block_y", "block_yaw", "goal_x", "goal_y")
    sizes: ClassVar = {"block_size": (BLOCK,)}
    colours: ClassVar = {"block_colour": (BLOCK,)}

    _lifted = False
    """Whether the block was lifted, and has not been put down beside the goal since."""

    @override
    def begin(self, world: World, rng: np.random.Generator) -> Vector:
        self._lifted = False
        return super().begin(world, rng)

    @override
    def add(self, spec: mujoco.MjSpec) -> None:
        super().add(spec)
        # A mocap body can be placed in each episode, and stands still.
        mark = spec.worldbody.add_body(name=GOAL, mocap=True)
        mark.add_geom(
            name=GOAL,
            type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            size=[self.options.goal_tolerance, 0.0005, 0],
            contype=0,
            conaffinity=0,
            rgba=[0.1, 0.55, 0.2, 1],
        )

    @override
    def arrange(self, world: World, rng: np.random.Generator, look: Mapping[str, float]) -> Sequence[float]:
        given = self.options
        distance, bearing = rng.uniform(*given.goal_distance), rng.uniform(*given.goal_bearing)
        goal = distance * math.cos(bearing), distance * math.sin(bearing)
        return *self.place_cube(world, BLOCK, rng, look["block_size"], "block"), *goal

    @override
    def show(self, world: World, factors: Vector) -> None:
        super().show(world, factors)
        world.data.mocap_pos[0, :2] = factors[3:5]

    @override
    def observe(self, world: World, out: Vector) -> None:
        super().observe(world, out)
        out[7:] = world.data.mocap_pos[0]

    @override
    def success(self, world: World) -> bool:
        """Whether the block is at rest on the goal, where it came over the table, and the robot does not touch it.

        A block that was lifted has to be pushed from where it then lies beside the goal.
        """
        away = world.pose(BLOCK)[:2] - world.data.mocap_pos[0, :2]
        on_goal, lowest = float(np.hypot(*away)) < self.options.goal_tolerance, height(world, BLOCK)
        if lowest > _LIFTED_M:
            self._lifted = True
        elif not on_goal and lowest < _LIES_M:
            self._lifted = False
        return on_goal and not self._lifted and self.at_rest(world, BLOCK)

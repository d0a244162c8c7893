"""Scene `handover`: one arm has to hand a bar to the other one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, override

import mujoco
import numpy as np

from ibrobot_core.api import HardwareError, Robot
from ibrobot_mujoco.scenes.options import HandoverOptions
from ibrobot_mujoco.scenes.solids import FRICTION, hue
from ibrobot_mujoco.scenes.table import REST_SPEED, TableScene
from ibrobot_mujoco.spans import ends
from ibrobot_mujoco.world import World

BAR = "bar"
BAR_LENGTH, BAR_WIDTH = 0.15, 0.02
"""Along y, and along x and z of its body [m]."""
_LIFTED_M = 0.05
"""Height above the table at which the bar is held [m]."""
_HALF_WAY_M = 0.05
"""Distance of the bar from the plane between both arms, on the side of the arm that gets it [m]."""


class Handover(TableScene[HandoverOptions]):
    """Observation: the pose of the bar."""

    moving = (BAR,)
    placed = ("bar_x", "bar_y", "bar_yaw")
    colours: ClassVar = {"bar_colour": (BAR,)}

    def __init__(self, options: HandoverOptions, robot: Robot) -> None:
        super().__init__(options, robot)
        if list(robot.description.arms) != ["left_", "right_"]:
            known = ", ".join(robot.description.arms) or "none"
            raise HardwareError(f"scene handover needs robot.description.arms left_ and right_, got {known}")

    @override
    def add(self, spec: mujoco.MjSpec) -> None:
        body = spec.worldbody.add_body(name=BAR, pos=[0.2, 0.1, BAR_WIDTH / 2])
        body.add_freejoint(name=BAR)
        body.add_geom(
            name=BAR, type=mujoco.mjtGeom.mjGEOM_BOX, size=[BAR_WIDTH / 2, BAR_LENGTH / 2, BAR_WIDTH / 2],
            density=400.0, condim=4, friction=FRICTION, rgba=hue(ends(self.options.bar_colour)[0]),
        )  # fmt: skip

    @override
    def arrange(self, world: World, rng: np.random.Generator, look: Mapping[str, float]) -> Sequence[float]:
        given = self.options

        def draw() -> tuple[float, float, float, float]:
            return rng.uniform(*given.bar_x), rng.uniform(*given.bar_y), BAR_WIDTH / 2, rng.uniform(*given.bar_yaw)

        x, y, _, yaw = self.place(world, BAR, draw, f"bar_x {list(given.bar_x)} and bar_y {list(given.bar_y)}", 0.02)
        return x, y, yaw

    @override
    def success(self, world: World) -> bool:
        """Whether the right arm alone holds the bar, above the table and on its own side."""
        _, y, z = world.pose(BAR)[:3]
        lifted = bool(z > _LIFTED_M and y < -_HALF_WAY_M and world.speed(BAR) <= REST_SPEED)
        return lifted and self.touched(world, BAR, "right_") and not self.touched(world, BAR, "left_")

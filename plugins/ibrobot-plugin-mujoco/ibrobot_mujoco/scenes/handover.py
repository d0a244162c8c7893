"""Scene `handover`: one arm has to hand a bar to the other one."""

from __future__ import annotations

import enum
from collections.abc import Mapping, Sequence
from typing import ClassVar, override

import mujoco
import numpy as np

from ibrobot_core.api import HardwareError, Robot, Vector
from ibrobot_mujoco.scenes.options import HandoverOptions
from ibrobot_mujoco.scenes.solids import FRICTION, hue
from ibrobot_mujoco.scenes.table import REST_SPEED, TableScene, touching
from ibrobot_mujoco.spans import ends
from ibrobot_mujoco.world import World

BAR = "bar"
BAR_LENGTH, BAR_WIDTH = 0.15, 0.02
"""Along y, and along x and z of its body [m]."""
_LIFTED_M = 0.05
"""Height above the table at which the bar is held [m]."""
_HALF_WAY_M = 0.05
"""Distance of the bar from the plane between both arms, on the side of the arm that gets it [m]."""


class _Stage(enum.Enum):
    """State of the bar."""

    LIES = enum.auto()
    """No hand holds it, or something else touches it."""
    LEFT = enum.auto()
    """The left hand held it last, alone."""
    BOTH = enum.auto()
    """Both held it after that."""


class Handover(TableScene[HandoverOptions]):
    """Observation: the pose of the bar."""

    moving = (BAR,)
    placed = ("bar_x", "bar_y", "bar_yaw")
    colours: ClassVar = {"bar_colour": (BAR,)}

    _stage = _Stage.LIES

    def __init__(self, options: HandoverOptions, robot: Robot) -> None:
        super().__init__(options, robot)
        if list(robot.description.arms) != ["left_", "right_"]:
            known = ", ".join(robot.description.arms) or "none"
            raise HardwareError(f"scene handover needs robot.description.arms left_ and right_, got {known}")
        grips = [name for name, grips in zip(robot.joint_names, robot.grips, strict=True) if grips]
        self._grips = [next((name for name in grips if name.startswith(arm)), "") for arm in robot.description.arms]
        if not all(self._grips):
            raise HardwareError("scene handover needs a joint of each arm, left_… and right_…, with grips: true")

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
    def begin(self, world: World, rng: np.random.Generator) -> Vector:
        self._stage = _Stage.LIES
        return super().begin(world, rng)

    @override
    def success(self, world: World) -> bool:
        """Whether the right hand holds the bar, above the table and on its own side, and got it from the left hand.

        The left hand alone held it first, then both, then the right one alone, and it lay nowhere in between. To hold
        is to have it between both jaws, while nothing else touches it.
        """
        around = touching(world, BAR)
        left, right = (jaws <= around for jaws in self._jaws_of(world))
        if around - self._bodies_of(world) or not (left or right):
            self._stage = _Stage.LIES
        elif left and not self.touched(world, BAR, "right_"):
            self._stage = _Stage.LEFT
        elif self._stage is _Stage.LEFT and right:
            self._stage = _Stage.BOTH if left else _Stage.LIES
        alone = self._stage is _Stage.BOTH and around == self._jaws_of(world)[1]
        _, y, z = world.pose(BAR)[:3]
        return alone and bool(z > _LIFTED_M and y < -_HALF_WAY_M and world.speed(BAR) <= REST_SPEED)

    def _jaws_of(self, world: World) -> list[set[int]]:
        """The bodies of the jaws of both hands, the left one first."""
        model = world.model
        moving = [int(model.jnt_bodyid[model.joint(name).id]) for name in self._grips]
        return [{jaw, int(model.body_parentid[jaw])} for jaw in moving]

"""Scene `drawer`: a drawer has to be opened."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, override

import mujoco
import numpy as np

from ibrobot_core.api import HardwareError, Vector
from ibrobot_mujoco.scenes.options import DrawerOptions
from ibrobot_mujoco.scenes.solids import FRICTION, hue
from ibrobot_mujoco.scenes.table import CLEARANCE, REST_SPEED, TableScene
from ibrobot_mujoco.spans import ends
from ibrobot_mujoco.world import World

CABINET, DRAWER = "cabinet", "drawer"
_DEPTH, _WIDTH, _HEIGHT, _PANEL = 0.13, 0.12, 0.05, 0.004
"""Sizes of the cabinet, and thickness of its panels [m]."""
_TRAVEL = 0.12
"""Distance by which the drawer opens at most [m]."""
_HANDLE = np.array([-0.036, 0.0, 0.03])
"""Middle of the handle in the frame of the cabinet, whose front is at x = 0, when the drawer is closed [m]."""
_HANDLE_SIZE = (0.008, 0.011, 0.02)
"""Half the lengths of the handle [m]."""
_FRICTION_N = 0.3
_TRIES = 1000

_Box = mujoco.mjtGeom.mjGEOM_BOX


class Drawer(TableScene[DrawerOptions]):
    """Observation: position of the handle [m] (3), direction of the pull (2), opening [m]."""

    further = ("handle.x", "handle.y", "handle.z", "pull.x", "pull.y", "opening")
    placed = ("handle_x", "handle_y", "drawer_yaw", "drawer_damping")
    colours: ClassVar = {"drawer_colour": (f"{DRAWER}_front", f"{DRAWER}_handle")}

    _touched = False
    """Whether the robot has touched the drawer in this episode."""

    @override
    def begin(self, world: World, rng: np.random.Generator) -> Vector:
        self._touched = False
        return super().begin(world, rng)

    @override
    def add(self, spec: mujoco.MjSpec) -> None:
        cabinet = spec.worldbody.add_body(name=CABINET, mocap=True, pos=[0.4, 0, 0])
        half, rgba = _WIDTH / 2, [0.55, 0.5, 0.45, 1]
        panels = {
            "top": ([_DEPTH / 2, 0, _HEIGHT], [_DEPTH / 2, half + _PANEL, _PANEL / 2]),
            "left": ([_DEPTH / 2, half + _PANEL / 2, _HEIGHT / 2], [_DEPTH / 2, _PANEL / 2, _HEIGHT / 2]),
            "right": ([_DEPTH / 2, -half - _PANEL / 2, _HEIGHT / 2], [_DEPTH / 2, _PANEL / 2, _HEIGHT / 2]),
            "back": ([_DEPTH, 0, _HEIGHT / 2], [_PANEL / 2, half, _HEIGHT / 2]),
        }
        for name, (pos, size) in panels.items():
            cabinet.add_geom(name=f"{CABINET}_{name}", type=_Box, pos=pos, size=size, rgba=rgba)
        drawer = cabinet.add_body(name=DRAWER)
        drawer.add_joint(
            name=DRAWER, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[-1, 0, 0], range=[0, _TRAVEL], limited=True,
            frictionloss=_FRICTION_N, armature=0.01,
        )  # fmt: skip
        # Gaps keep the drawer from rubbing against the cabinet.
        inner, low = half - 0.003, 0.006
        colour = hue(ends(self.options.drawer_colour)[0])
        parts: dict[str, tuple[Any, Any, Any]] = {
            "front": ([0.0, 0, _HEIGHT / 2], [0.004, inner, _HEIGHT / 2 - low], colour),
            "floor": ([_DEPTH / 2 - 0.01, 0, low + 0.002], [_DEPTH / 2 - 0.01, inner, 0.002], rgba),
            "stem": ([_HANDLE[0] / 2, 0, _HANDLE[2] - 0.012], [abs(_HANDLE[0]) / 2, 0.004, 0.004], colour),
            "handle": (_HANDLE, _HANDLE_SIZE, colour),
        }
        for name, (pos, size, shade) in parts.items():
            drawer.add_geom(
                name=f"{DRAWER}_{name}", type=_Box, pos=pos, size=size, rgba=shade, density=500.0, condim=4,
                friction=FRICTION,
            )  # fmt: skip

    @override
    def arrange(self, world: World, rng: np.random.Generator, look: Mapping[str, float]) -> Sequence[float]:
        given, model = self.options, world.model
        world.data.joint(DRAWER).qpos = 0.0
        bodies = {model.body(CABINET).id, model.body(DRAWER).id}
        for _ in range(_TRIES):
            distance, bearing = rng.uniform(*given.handle_distance), rng.uniform(*given.handle_bearing)
            yaw = bearing + rng.uniform(*given.drawer_turn)
            damping = rng.uniform(*ends(given.drawer_damping))
            x, y = distance * math.cos(bearing), distance * math.sin(bearing)
            self._put(world, x, y, yaw)
            if self.is_clear(world, bodies, CLEARANCE):
                return x, y, yaw, damping
        raise HardwareError(
            f"found no place for the drawer {CLEARANCE} m clear of the robot in {_TRIES} tries: handle_distance "
            f"{list(given.handle_distance)} and handle_bearing {list(given.handle_bearing)} must leave one"
        )

    def _put(self, world: World, x: float, y: float, yaw: float) -> None:
        """Place the cabinet so that the handle of the closed drawer is at `x`, `y` [m]."""
        number = int(world.model.body(CABINET).mocapid[0])
        offset = _HANDLE[0] * np.array([math.cos(yaw), math.sin(yaw)])
        world.data.mocap_pos[number] = [x - offset[0], y - offset[1], 0.0]
        world.data.mocap_quat[number] = [math.cos(yaw / 2), 0, 0, math.sin(yaw / 2)]

    @override
    def show(self, world: World, factors: Vector) -> None:
        super().show(world, factors)
        x, y, yaw, damping = factors[:4].tolist()
        self._put(world, x, y, yaw)
        self._yaw, self._handle = yaw, np.array([x, y])
        world.model.dof_damping[world.model.joint(DRAWER).dofadr] = damping

    @override
    def observe(self, world: World, out: Vector) -> None:
        opening = float(world.data.joint(DRAWER).qpos[0])
        pull = -np.array([math.cos(self._yaw), math.sin(self._yaw)])
        out[:2] = self._handle + opening * pull
        out[2] = _HANDLE[2]
        out[3:5] = pull
        out[5] = opening

    @override
    def success(self, world: World) -> bool:
        """Whether the robot has touched the drawer, it is open, and does not move."""
        joint = world.data.joint(DRAWER)
        self._touched = self._touched or self.touched(world, DRAWER)
        return self._touched and bool(joint.qpos[0] >= self.options.opened and abs(joint.qvel[0]) <= REST_SPEED)

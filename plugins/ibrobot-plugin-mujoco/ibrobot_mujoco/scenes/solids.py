"""Solids that scenes consist of: cubes, bins, marks."""

from __future__ import annotations

import colorsys
from collections.abc import Sequence

import mujoco
import numpy as np

from ibrobot_core.api import Vector

DENSITY = 1000.0
FRICTION = (1.0, 0.005, 0.0001)
BIN_INNER = 0.11
"""Inner edge of a square bin [m]."""
BIN_HEIGHT = 0.05
"""Height of a bin's rim above the table [m]."""
BIN_WALL = 0.004
BLUE, RED = (0.16, 0.36, 0.62, 1.0), (0.70, 0.16, 0.13, 1.0)

_Box = mujoco.mjtGeom.mjGEOM_BOX


def hue(value: float) -> Vector:
    """The colour of a hue from 0 to 1, shape (4,)."""
    return np.array([*colorsys.hsv_to_rgb(value % 1.0, 0.88, 0.85), 1.0])


def add_cube(spec: mujoco.MjSpec, name: str, size: float) -> None:
    """A red cube that moves, with body, free joint and geom of one name."""
    body = spec.worldbody.add_body(name=name, pos=[0.24, 0, size / 2])
    body.add_freejoint(name=name)
    body.add_geom(name=name, type=_Box, size=[size / 2] * 3, density=DENSITY, condim=4, friction=FRICTION, rgba=RED)


def add_bin(spec: mujoco.MjSpec, name: str, position: tuple[float, float], rgba: Sequence[float]) -> None:
    """A bin; the frame of its body is at the middle of the bin's floor, on the table."""
    body = spec.worldbody.add_body(name=name, pos=[*position, 0])
    inner, wall, rim = BIN_INNER / 2, BIN_WALL / 2, BIN_HEIGHT / 2
    outer, middle = inner + BIN_WALL, inner + wall
    boxes = {
        "floor": ([0, 0, wall], [outer, outer, wall]),
        "left": ([0, middle, rim], [outer, wall, rim]),
        "right": ([0, -middle, rim], [outer, wall, rim]),
        "front": ([middle, 0, rim], [wall, inner, rim]),
        "back": ([-middle, 0, rim], [wall, inner, rim]),
    }
    for part, (pos, size) in boxes.items():
        body.add_geom(name=f"{name}_{part}", type=_Box, pos=pos, size=size, rgba=rgba)


def is_in_bin(position: Vector, centre: Vector) -> bool:
    """Whether a position, shape (3,), is in the bin whose centre is `centre`, below its rim."""
    return bool(np.all(np.abs(position - centre) < [BIN_INNER / 2, BIN_INNER / 2, BIN_HEIGHT / 2]))


def bin_centre(position: tuple[float, float]) -> Vector:
    """The centre of a bin at `position`, shape (3,)."""
    return np.array([*position, BIN_HEIGHT / 2])


def resize_cube(model: mujoco.MjModel, name: str, size: float) -> None:
    """Change the edge of a cube, and with it mass and inertia; `mj_setConst` has to follow."""
    geom, body = model.geom(name).id, model.body(name).id
    half = size / 2
    mass = DENSITY * size**3
    model.geom_size[geom] = half
    model.geom_rbound[geom] = half * 3**0.5
    model.geom_aabb[geom, 3:] = half
    model.bvh_aabb[model.body_bvhadr[body], 3:] = half
    model.body_mass[body] = mass
    model.body_inertia[body] = mass * size**2 / 6

"""The task of scene `pick_cube`: the initial pose of the cube, and whether it is in the bin."""

from __future__ import annotations

import math

import mujoco
import numpy as np

from ibrobot_core.api import HardwareError, Vector
from ibrobot_mujoco.model import BIN, BIN_HEIGHT, BIN_INNER, CUBE, TABLE
from ibrobot_mujoco.options import MujocoOptions

CLEARANCE = 0.03
"""Minimum distance between the cube's initial pose and everything except the table [m]."""
REST_SPEED = 0.05
"""Speed below which the cube counts as at rest [m/s]."""
_TRIES = 1000


class PickCube:
    """Places the cube of a model, observes it, and judges success."""

    def __init__(self, options: MujocoOptions, model: mujoco.MjModel) -> None:
        self._options = options
        self._model = model
        self._cube = model.geom(CUBE).id
        self._qpos = int(model.joint(CUBE).qposadr[0])
        self._dof = int(model.joint(CUBE).dofadr[0])
        self._bin: Vector = np.add(model.body(BIN).pos, (0, 0, BIN_HEIGHT / 2))
        scenery = [model.body(name).id for name in ("world", CUBE, BIN, *options.objects)]
        self._of_robot = ~np.isin(model.geom_bodyid, scenery)
        solid = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
        solid[[self._cube, model.geom(TABLE).id]] = False
        self._obstacles = [int(i) for i in np.flatnonzero(solid)]

    def place(self, physics: mujoco.MjData, rng: np.random.Generator) -> None:
        """Place the cube on the table at random, clear of the robot's present pose and of the bin.

        Raises:
            HardwareError: if the options leave no such place.
        """
        options = self._options
        for _ in range(_TRIES):
            distance, bearing = rng.uniform(*options.cube_distance), rng.uniform(*options.cube_bearing)
            yaw = rng.uniform(*options.cube_yaw)
            position = distance * math.cos(bearing), distance * math.sin(bearing), options.cube_size / 2
            physics.qpos[self._qpos : self._qpos + 7] = *position, math.cos(yaw / 2), 0, 0, math.sin(yaw / 2)
            mujoco.mj_kinematics(self._model, physics)
            if all(self._distance(physics, obstacle) >= CLEARANCE for obstacle in self._obstacles):
                return
        raise HardwareError(
            f"found no place for the cube {CLEARANCE} m clear of robot and bin in {_TRIES} tries: "
            f"cube_distance {list(options.cube_distance)} and cube_bearing {list(options.cube_bearing)} must leave one"
        )

    def _distance(self, physics: mujoco.MjData, obstacle: int) -> float:
        return float(mujoco.mj_geomDistance(self._model, physics, self._cube, obstacle, CLEARANCE, None))

    def observe(self, physics: mujoco.MjData, out: Vector) -> None:
        """Write the ground truth into `out`, shape (10,): cube position and quaternion wxyz, centre of the bin."""
        out[:7] = physics.qpos[self._qpos : self._qpos + 7]
        out[7:] = self._bin

    def success(self, physics: mujoco.MjData) -> bool:
        """Whether the cube lies in the bin, below the rim, and the robot does not touch it."""
        offset = np.abs(physics.qpos[self._qpos : self._qpos + 3] - self._bin)
        inside = bool(np.all(offset < [BIN_INNER / 2, BIN_INNER / 2, BIN_HEIGHT / 2]))
        if not inside or np.linalg.norm(physics.qvel[self._dof : self._dof + 3]) > REST_SPEED:
            return False
        pairs = physics.contact.geom
        others = pairs[(pairs == self._cube).any(axis=1)].ravel()
        return not self._of_robot[others].any()

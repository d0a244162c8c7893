"""MuJoCo's model of an arm among objects: where the tool is, and how far the moving links are from the world."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import mujoco
import numpy as np
from ibrobot_kinematics import read_mjcf
from ibrobot_kinematics.poses import matrix
from ibrobot_planning.world.objects import Box, Cylinder, World

from ibrobot_core.api import Vector

FAR_M = 0.02
"""Greatest distance that is told."""


class Referee:
    """An arm with a world of boxes and cylinders, whose shapes MuJoCo makes by itself.

    Args:
        mjcf: of the arm.
        joints: names of those that move, J of them.
        world: the objects.
        tip: site of the tool; only `poses` needs it.
    """

    def __init__(self, mjcf: Path, joints: Sequence[str], world: World, tip: str = "") -> None:
        spec = read_mjcf(mjcf).spec.copy()
        for body in spec.bodies:
            geoms = list(body.geoms)
            if not any(geom.contype or geom.conaffinity for geom in geoms):
                for geom in geoms:
                    geom.contype = 1
        for geom in list(spec.geoms):
            if not (geom.contype or geom.conaffinity):
                spec.delete(geom)
        used = {geom.meshname for geom in spec.geoms}
        for mesh in list(spec.meshes):
            if mesh.name not in used:
                spec.delete(mesh)
        for name, thing in world.objects.items():
            placed, quaternion, shape = matrix(thing.pose), np.zeros(4), thing.shape
            mujoco.mju_mat2Quat(quaternion, placed[:3, :3].ravel())
            if isinstance(shape, Box):
                kind, size = mujoco.mjtGeom.mjGEOM_BOX, [each / 2 for each in shape.size]
            else:
                assert isinstance(shape, Cylinder)
                kind, size = mujoco.mjtGeom.mjGEOM_CYLINDER, [shape.radius, shape.height / 2, 0]
            spec.worldbody.add_geom(name=f"world:{name}", type=kind, size=size, pos=placed[:3, 3], quat=quaternion)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        bodies, still = self.model.geom_bodyid, self.model.body_weldid
        names = [self.model.geom(i).name for i in range(self.model.ngeom)]
        self._objects = [i for i, name in enumerate(names) if name.startswith("world:")]
        self._links = [i for i in range(self.model.ngeom) if still[bodies[i]] != 0]
        self._columns = [int(self.model.joint(name).qposadr[0]) for name in joints]
        self._tip = self.model.site(tip).id if tip else -1

    def poses(self, positions: Vector) -> Iterator[tuple[Vector, Vector]]:
        """Position [m], shape (3,), and axes, shape (3, 3), of the tool at each of configurations, shape (N, J)."""
        for q in positions:
            self.data.qpos[self._columns] = q
            mujoco.mj_kinematics(self.model, self.data)
            yield self.data.site_xpos[self._tip], self.data.site_xmat[self._tip].reshape(3, 3)

    def clearance(self, positions: Vector) -> float:
        """Least distance [m] of the moving links from the world over configurations, shape (N, J); at most 2 cm."""
        least, places, bounds = FAR_M, self.data.geom_xpos, self.model.geom_rbound
        together = bounds[self._links][:, None] + bounds[self._objects][None]
        for _ in self.poses(positions):
            away = np.linalg.norm(places[self._links][:, None] - places[self._objects][None], axis=2) - together
            for link, thing in np.argwhere(away < least).tolist():
                pair = self._links[link], self._objects[thing]
                least = min(least, mujoco.mj_geomDistance(self.model, self.data, *pair, least, None))
        return least

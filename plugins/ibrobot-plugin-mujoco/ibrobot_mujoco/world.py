"""The simulated world as scenes see it."""

from __future__ import annotations

from collections.abc import Iterable

import attrs
import mujoco

from ibrobot_core.api import Vector


@attrs.frozen(eq=False)
class World:
    """A compiled model and its state: the `World` of scenes, whose `Spec` is `mujoco.MjSpec`."""

    model: mujoco.MjModel
    data: mujoco.MjData

    @classmethod
    def of(cls, model: mujoco.MjModel) -> World:
        """A world in its reference state."""
        return cls(model, mujoco.MjData(model))

    def pose(self, body: str) -> Vector:
        """Position [m] and quaternion wxyz of a body with a free joint of the same name, shape (7,); a copy."""
        start = int(self.model.joint(body).qposadr[0])
        pose: Vector = self.data.qpos[start : start + 7].copy()
        return pose

    def put(self, body: str, pose: Vector) -> None:
        """Set the pose of a body with a free joint, as from `pose`."""
        start = int(self.model.joint(body).qposadr[0])
        self.data.qpos[start : start + 7] = pose

    def speed(self, body: str) -> float:
        """Speed of a body with a free joint [m/s]."""
        start = int(self.model.joint(body).dofadr[0])
        velocity = self.data.qvel[start : start + 3]
        return float((velocity @ velocity) ** 0.5)


def bodies_of(model: mujoco.MjModel, joints: Iterable[str]) -> frozenset[int]:
    """The bodies of the arms with these joints: their links, and what carries them or is fixed to them."""
    links = [int(model.jnt_bodyid[model.joint(name).id]) for name in joints]
    roots = {int(model.body_rootid[link]) for link in links}
    return frozenset(body for body in range(1, model.nbody) if int(model.body_rootid[body]) in roots)

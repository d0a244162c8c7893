"""Signals of the simulation: the physics state, for cameras and viewers, and the scene's ground truth."""

from __future__ import annotations

import mujoco
import numpy as np

from ibrobot_core.api import NS_PER_S, Float64MultiArray, Robot, SensorError, Vector
from ibrobot_core.app import Subscription
from ibrobot_mujoco.model import AnyScene, build_world
from ibrobot_mujoco.options import MujocoOptions
from ibrobot_mujoco.world import World

PHYSICS_TOPIC = "/simulation/physics"
"""Stamp as whole seconds and remaining nanoseconds (2, each exact as a float), MuJoCo's state (nq), and the factors of
the episode."""
SCENE_TOPIC = "/simulation/scene"
"""Ground truth of the scene; see its `values`."""
OBJECTS_TOPIC = "/simulation/objects"
"""Pose of each object of `simulation.objects` that has a mass, in file order: position [m] (3), quaternion wxyz (4)."""
POSE_SIZE = 7
_STAMP_SIZE = 2
# Positions are sufficient for rendering.
_STATE = mujoco.mjtState.mjSTATE_QPOS


def physics_size(world: World, scene: AnyScene) -> int:
    """Number of values in a message on `PHYSICS_TOPIC`."""
    return _STAMP_SIZE + int(mujoco.mj_stateSize(world.model, _STATE)) + len(scene.factors)


def write_physics(world: World, factors: Vector, stamp_ns: int, out: Vector) -> None:
    """Write stamp, state and factors into `out`, shape (physics_size,)."""
    out[:_STAMP_SIZE] = divmod(stamp_ns, NS_PER_S)
    end = out.size - factors.size
    mujoco.mj_getState(world.model, world.data, out[_STAMP_SIZE:end], _STATE)
    out[end:] = factors


def stamp_of(vector: Vector) -> int:
    """The stamp [ns] of a physics state."""
    return int(vector[0]) * NS_PER_S + int(vector[1])


class DrawnWorld:
    """A world for rendering, which follows the physics state on the bus."""

    def __init__(self, world: World, scene: AnyScene) -> None:
        self._world, self._scene = world, scene
        self.model, self.data = world.model, world.data
        self._shown = np.full(len(scene.factors), np.nan)

    @classmethod
    def of(cls, options: MujocoOptions, robot: Robot, *, visual: bool = True) -> DrawnWorld:
        """The world of a simulation, with its visual model or that of the physics."""
        return cls(*build_world(options, robot, visual=visual))

    def follow(self, vector: Vector) -> None:
        """Adopt a physics state, as far as rendering needs it: bodies, cameras, lights, colours and sizes.

        Raises:
            SensorError: if the state is from another scene.
        """
        size = physics_size(self._world, self._scene)
        if vector.size != size:
            raise SensorError(f"{PHYSICS_TOPIC} has {vector.size} values, but this scene has {size}")
        end = size - self._shown.size
        if not np.array_equal(vector[end:], self._shown):
            self._shown = vector[end:].copy()
            self._scene.show(self._world, self._shown)
        mujoco.mj_setState(self.model, self.data, np.ascontiguousarray(vector[_STAMP_SIZE:end]), _STATE)
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)


def newest(subscription: Subscription, timeout_s: float | None = 0.0) -> Vector | None:
    """The newest queued physics state, shape (physics_size,); None if none arrives within `timeout_s` [s]."""
    first = subscription.get(timeout_s)
    if first is None:
        return None
    message = (subscription.drain() or [first])[-1].message
    assert isinstance(message, Float64MultiArray)
    return message.data

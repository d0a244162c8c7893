"""Signals of the simulation: the physics state, for cameras and viewers, and the scene's ground truth."""

from __future__ import annotations

import mujoco
import numpy as np

from ibrobot_core.api import NS_PER_S, Float64MultiArray, SensorError, Vector
from ibrobot_core.app import Subscription

PHYSICS_TOPIC = "/simulation/physics"
"""Stamp as whole seconds and remaining nanoseconds (2, each exact as a float), then MuJoCo's state (nq)."""
SCENE_TOPIC = "/simulation/scene"
"""Cube position [m] (3), cube orientation as a quaternion wxyz (4), centre of the bin [m] (3); base frame."""
SCENE_SIZE = 10
OBJECTS_TOPIC = "/simulation/objects"
"""Of each object of `simulation.objects` that has a mass, in file order: position [m] (3), quaternion wxyz (4)."""
POSE_SIZE = 7
_STAMP_SIZE = 2
# Positions are sufficient for rendering.
_STATE = mujoco.mjtState.mjSTATE_QPOS


def physics_size(model: mujoco.MjModel) -> int:
    """Number of values in a message on `PHYSICS_TOPIC`."""
    return _STAMP_SIZE + int(mujoco.mj_stateSize(model, _STATE))


def write_physics(model: mujoco.MjModel, physics: mujoco.MjData, stamp_ns: int, out: Vector) -> None:
    """Write the stamped state into `out`, shape (physics_size,)."""
    out[:_STAMP_SIZE] = divmod(stamp_ns, NS_PER_S)
    mujoco.mj_getState(model, physics, out[_STAMP_SIZE:], _STATE)


def stamp_of(vector: Vector) -> int:
    """The stamp [ns] of a physics state."""
    return int(vector[0]) * NS_PER_S + int(vector[1])


def pose_scene(model: mujoco.MjModel, drawn: mujoco.MjData, vector: Vector) -> None:
    """Set `drawn` to a physics state, as far as rendering needs it: bodies, cameras and lights.

    Raises:
        SensorError: if the state is from another scene.
    """
    if vector.size != physics_size(model):
        raise SensorError(f"{PHYSICS_TOPIC} has {vector.size} values, but this scene has {physics_size(model)}")
    mujoco.mj_setState(model, drawn, np.ascontiguousarray(vector[_STAMP_SIZE:]), _STATE)
    mujoco.mj_kinematics(model, drawn)
    mujoco.mj_comPos(model, drawn)
    mujoco.mj_camlight(model, drawn)


def newest(subscription: Subscription, timeout_s: float | None = 0.0) -> Vector | None:
    """The newest queued physics state, shape (physics_size,); None if none arrives within `timeout_s` [s]."""
    first = subscription.get(timeout_s)
    if first is None:
        return None
    message = (subscription.drain() or [first])[-1].message
    assert isinstance(message, Float64MultiArray)
    return message.data

"""The objects around the robot, as shapes for planners."""

from __future__ import annotations

import mujoco
from ibrobot_kinematics.poses import orientation

from ibrobot_core.api import Pose, Robot, SceneObject, Vector3
from ibrobot_mujoco.model import build_world
from ibrobot_mujoco.options import MujocoOptions
from ibrobot_mujoco.state import OBJECTS_TOPIC, POSE_SIZE, SCENE_TOPIC
from ibrobot_mujoco.world import bodies_of


def scene_objects(options: MujocoOptions, robot: Robot) -> tuple[SceneObject, ...]:
    """The table, the solid geoms of the scene, and `objects`, with the names of their geoms.

    Raises:
        HardwareError: as `build_model`.
    """
    world, scene = build_world(options, robot, visual=False)
    model, physics = world.model, world.data
    mujoco.mj_kinematics(model, physics)
    free = [name for name, thing in options.objects.items() if thing.mass is not None]
    signals = {name: (OBJECTS_TOPIC, POSE_SIZE * i) for i, name in enumerate(free)}
    signals |= {name: (SCENE_TOPIC, first) for name, first in scene.poses.items()}
    robots = bodies_of(model, robot.joint_names)
    objects = []
    for geom in range(model.ngeom):
        body = int(model.geom_bodyid[geom])
        if body not in robots and (model.geom_contype[geom] or model.geom_conaffinity[geom]):
            topic, first = signals.get(model.body(body).name, ("", 0))
            objects.append(_object(model, physics, geom, topic, first))
    return tuple(objects)


def _object(model: mujoco.MjModel, physics: mujoco.MjData, geom: int, topic: str, first: int) -> SceneObject:
    pose = Pose(Vector3(*physics.geom_xpos[geom].tolist()), orientation(physics.geom_xmat[geom].reshape(3, 3)))
    name, size = model.geom(geom).name, model.geom_size[geom].tolist()
    material = int(model.geom_matid[geom])
    color = tuple((model.mat_rgba[material] if material >= 0 else model.geom_rgba[geom]).tolist())
    match int(model.geom_type[geom]):
        case mujoco.mjtGeom.mjGEOM_PLANE:
            return SceneObject(name, "plane", (), pose, topic, first, color)
        case mujoco.mjtGeom.mjGEOM_SPHERE:
            return SceneObject(name, "sphere", (size[0],), pose, topic, first, color)
        case mujoco.mjtGeom.mjGEOM_CYLINDER:
            return SceneObject(name, "cylinder", (size[0], 2 * size[1]), pose, topic, first, color)
        case _:
            return SceneObject(name, "box", tuple(2 * each for each in size), pose, topic, first, color)

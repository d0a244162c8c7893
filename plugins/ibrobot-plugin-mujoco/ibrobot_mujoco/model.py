"""The scene as a MuJoCo model: the robot's MJCF, a table, the objects of the scene, and further ones.

The physics model has no visual meshes, the visual model has low-poly ones; both have the same layout of qpos and qvel.
"""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
from ibrobot_kinematics.errors import KinematicsError
from ibrobot_kinematics.mjcf import delete_unused_meshes, mesh_name, read_mjcf, several_arms
from ibrobot_kinematics.rotations import quaternion
from numpy.typing import NDArray

from ibrobot_core.api import NS_PER_S, HardwareError, Robot, ns
from ibrobot_core.app import ConfigError
from ibrobot_mujoco.lowpoly import GRID_M, low_poly
from ibrobot_mujoco.options import MujocoOptions, SceneCamera, SceneThing
from ibrobot_mujoco.parameters import ArmParameters, read_parameters
from ibrobot_mujoco.scene import Scene
from ibrobot_mujoco.scenes.solids import FRICTION
from ibrobot_mujoco.scenes.table import TABLE
from ibrobot_mujoco.world import World

CAMERAS = (
    SceneCamera(name="top", pos=(0.16, 0.04, 0.80), lookat=(0.16, 0.04, 0.0), fovy=42.0),
    SceneCamera(name="front", pos=(0.75, -0.25, 0.42), lookat=(0.14, 0.05, 0.07), fovy=42.0),
)
"""The cameras of every scene, in addition to those of the MJCF."""

_Mesh = mujoco.mjtGeom.mjGEOM_MESH
_Box = mujoco.mjtGeom.mjGEOM_BOX
_HOLDS = [0.97, 0.97, 0.001, 0.5, 2.0]
"""`solimp` of dry friction. With MuJoCo's own, 0.9, a loaded joint at rest creeps by a degree in seconds, where the
gears of a servo hold; so it creeps less than a third as fast. From 0.99, a fit takes backlash for friction."""
_SHAPES = {"box": _Box, "sphere": mujoco.mjtGeom.mjGEOM_SPHERE, "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER}


type AnyScene = Scene[mujoco.MjSpec, World]


def build_world(options: MujocoOptions, robot: Robot, *, visual: bool) -> tuple[World, AnyScene]:
    """Compile a world for rendering (`visual`) or for physics. Returns it with its scene.

    Raises:
        HardwareError: e.g. if there is no MJCF, or it has no position actuator for a joint.
    """
    spec, scene = build_spec(options, robot)
    if visual:
        # Multisampling doubles the time of a software renderer.
        spec.visual.quality.offsamples = 0
        spec.visual.quality.shadowsize = 2048  # a third cheaper than the default, looks the same
        _simplify(spec)
    else:
        _strip(spec)
    try:
        return World.of(spec.compile()), scene
    except ValueError as error:
        raise HardwareError(f"{robot.description.mjcf} does not compile: {error}") from error


def build_model(options: MujocoOptions, robot: Robot, *, visual: bool) -> mujoco.MjModel:
    """The model of `build_world`."""
    return build_world(options, robot, visual=visual)[0].model


def build_spec(options: MujocoOptions, robot: Robot) -> tuple[mujoco.MjSpec, AnyScene]:
    """Build the editable model, with the MJCF's full meshes. Returns it with its scene.

    Raises:
        HardwareError: e.g. if there is no MJCF, or it has no position actuator for a joint.
    """
    path = robot.description.mjcf
    if path is None:
        raise HardwareError(f"robot {robot.name!r} has no MJCF to simulate: set robot.description.mjcf")
    arms = robot.description.arms
    try:
        spec = several_arms(path, arms) if arms else read_mjcf(path).spec.copy()
    except KinematicsError as error:
        raise HardwareError(str(error)) from error
    spec.option.timestep = ns(options.timestep) / NS_PER_S
    # Grasping needs both: with a pyramidal cone, or an impedance ratio of 1, the cube slips out.
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10
    _tune_servos(spec, options, robot)
    if options.parameters is not None:
        try:
            apply_parameters(spec, read_parameters(options.parameters, robot), robot)
        except ConfigError as error:
            raise HardwareError(str(error)) from None
    _add_surroundings(spec)
    scene: AnyScene = options.scene.make(robot)
    scene.build(spec)
    for name, thing in options.objects.items():
        _add_thing(spec, name, thing)
    present = {camera.name for camera in spec.cameras}
    for camera in CAMERAS:
        if camera.name not in present:
            _add_camera(spec, camera)
    for camera in options.cameras:
        _add_camera(spec, camera)
    return spec, scene


def apply_parameters(spec: mujoco.MjSpec, parameters: ArmParameters, robot: Robot) -> None:
    """Give servos and joints their parameters, before anything but the arm is in the model.

    Delay, backlash and bias are not among those of MuJoCo; see `setpoints`.
    """
    actuators = {a.target: a for a in spec.actuators if a.trntype == mujoco.mjtTrn.mjTRN_JOINT}
    for name in robot.joint_names:
        each, servo, joint = parameters.joints[name], actuators[name], spec.joint(name)
        servo.gainprm[0], servo.biasprm[1], servo.biasprm[2] = each.kp, -each.kp, 0.0
        if each.torque_limit is not None:
            servo.forcelimited = True
            servo.forcerange = [-each.torque_limit, each.torque_limit]
        for field in ("damping", "frictionloss", "armature"):
            _set_joint(joint, field, getattr(each, field))
        joint.solimp_friction = _HOLDS
    if parameters.gravity_compensation is not None:
        for body in spec.bodies[1:]:
            body.gravcomp = parameters.gravity_compensation


def _tune_servos(spec: mujoco.MjSpec, options: MujocoOptions, robot: Robot) -> None:
    """Find each joint's position actuator, and apply the options."""
    joints = {joint.name: joint for joint in spec.joints}
    actuators = {a.target: a for a in spec.actuators if a.trntype == mujoco.mjtTrn.mjTRN_JOINT}
    for name in robot.joint_names:
        if name not in joints:
            raise HardwareError(f"{robot.description.mjcf} has no joint {name!r}; it has: {', '.join(joints)}")
        servo = actuators.get(name)
        if servo is None or servo.biastype != mujoco.mjtBias.mjBIAS_AFFINE or servo.gainprm[0] != -servo.biasprm[1]:
            raise HardwareError(f"{robot.description.mjcf} has no position actuator for joint {name!r}")
        if options.kp is not None:
            servo.gainprm[0], servo.biasprm[1] = options.kp, -options.kp
        if options.kv is not None:
            servo.biasprm[2] = -options.kv
        if options.torque_limit is not None:
            servo.forcelimited = True
            servo.forcerange = [-options.torque_limit, options.torque_limit]
        for field in ("damping", "frictionloss", "armature"):
            value = getattr(options, field)
            if value is not None:
                _set_joint(joints[name], field, value)


def _set_joint(joint: mujoco.MjsJoint, field: str, value: float) -> None:
    # In newer versions of MuJoCo, damping is a list of polynomial coefficients; in older ones a number.
    old = getattr(joint, field)
    setattr(joint, field, value if np.ndim(old) == 0 else [value, *np.zeros(len(old) - 1)])


def _add_surroundings(spec: mujoco.MjSpec) -> None:
    world = spec.worldbody
    spec.add_texture(
        name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.75, 0.82, 0.9], rgb2=[0.4, 0.48, 0.58], width=64, height=384,
    )  # fmt: skip
    # The relevant part of the scene; it scales shadows and the cameras' near plane.
    spec.stat.center, spec.stat.extent = [0.15, 0.0, 0.1], 0.6
    spec.visual.map.shadowclip = 2
    spec.visual.headlight.ambient = [0.4, 0.4, 0.4]
    spec.visual.headlight.diffuse = [0.25, 0.25, 0.25]
    spec.visual.headlight.specular = [0.0, 0.0, 0.0]
    world.add_light(
        name="lamp", type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, pos=[0.45, -0.4, 1.1], dir=[-0.3, 0.4, -1.0],
        diffuse=[0.6, 0.6, 0.58], specular=[0.15, 0.15, 0.15], castshadow=True,
    )  # fmt: skip
    # A plane has contacts everywhere; its size only affects rendering.
    world.add_geom(
        name=TABLE,
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        pos=[0.15, 0, 0],
        size=[0.6, 0.6, 0.05],
        rgba=[0.72, 0.70, 0.66, 1],
        friction=FRICTION,
    )


def _add_thing(spec: mujoco.MjSpec, name: str, thing: SceneThing) -> None:
    if spec.body(name) is not None or spec.geom(name) is not None:
        raise HardwareError(f"simulation.objects: the scene has {name!r} already; give the object another name")
    turn = [np.cos(thing.yaw / 2), 0, 0, np.sin(thing.yaw / 2)]
    body = spec.worldbody.add_body(name=name, pos=thing.position, quat=turn)
    if thing.mass is not None:
        body.add_freejoint(name=name)
    sizes = [each / 2 for each in thing.size or ()] or [thing.radius or 0.0, (thing.height or 0.0) / 2, 0.0]
    body.add_geom(
        name=name,
        type=_SHAPES[thing.shape],
        size=sizes,
        mass=thing.mass or 1.0,
        friction=FRICTION,
        rgba=[0.35, 0.55, 0.35, 1],
    )


def _add_camera(spec: mujoco.MjSpec, camera: SceneCamera) -> None:
    if spec.camera(camera.name) is not None:
        raise HardwareError(f"simulation.cameras: the scene has a camera {camera.name!r} already")
    body = spec.body(camera.parent)
    if body is None:
        bodies = ", ".join(b.name for b in spec.bodies)
        raise HardwareError(f"camera {camera.name!r}: no body {camera.parent!r}; the bodies are: {bodies}")
    body.add_camera(name=camera.name, pos=camera.pos, quat=_look_at(camera), fovy=camera.fovy)


def _look_at(camera: SceneCamera) -> NDArray[np.float64]:
    """Orientation of a camera (which looks along its -z, with y up) as a quaternion wxyz, shape (4,)."""
    backward = np.subtract(camera.pos, camera.lookat)
    backward /= np.linalg.norm(backward)
    # For a camera that looks straight down, "up" in the image is the robot's forward direction.
    up = np.array([1.0, 0.0, 0.0]) if abs(backward[2]) > 0.999 else np.array([0.0, 0.0, 1.0])
    right = np.cross(up, backward)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(backward, right), backward], axis=1)
    return np.roll(quaternion(rotation), 1)


def _strip(spec: mujoco.MjSpec) -> None:
    """Remove elements without effect on the motion. Visual geoms that contribute mass are kept."""
    for geom in list(spec.geoms):
        if geom.type == _Mesh and not geom.contype and not geom.conaffinity and geom.parent.explicitinertial:
            spec.delete(geom)
    delete_unused_meshes(spec)


def _simplify(spec: mujoco.MjSpec) -> None:
    """Replace visual STL meshes by low-poly ones; meshes in other formats are unchanged."""
    delete_unused_meshes(spec)
    colliding = {g.meshname for g in spec.geoms if g.type == _Mesh and (g.contype or g.conaffinity)}
    directory = Path(spec.modelfiledir) / spec.meshdir
    for mesh in spec.meshes:
        name = mesh_name(mesh)
        if name in colliding or Path(mesh.file).suffix.lower() != ".stl":
            continue
        scale = float(np.max(np.abs(mesh.scale)))
        vertices, faces = low_poly(directory / mesh.file, GRID_M / scale)
        mesh.name, mesh.file = name, ""
        mesh.uservert, mesh.userface = vertices.ravel(), faces.ravel()
        # Clustered meshes are not closed, so their inertia cannot be computed from a volume.
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL

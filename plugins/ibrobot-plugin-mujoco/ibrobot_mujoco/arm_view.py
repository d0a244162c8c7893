"""Where a camera sees what moves against it: the arm, drawn as it stands, in a camera whose place is known."""

from __future__ import annotations

import math
from pathlib import Path

import mujoco
import numpy as np
from ibrobot_kinematics.errors import KinematicsError
from ibrobot_kinematics.link_chain import Chain
from ibrobot_kinematics.mjcf import Mjcf, read_mjcf, several_arms
from ibrobot_kinematics.poses import homogeneous
from ibrobot_kinematics.rotations import from_quaternion, from_rpy, quaternion
from ibrobot_kinematics.urdf import read_urdf
from numpy.typing import NDArray

from ibrobot_core.api import CameraInfo, NotSupported, Vector
from ibrobot_core.app import Mount, RobotConfig
from ibrobot_mujoco.camera import find_camera
from ibrobot_mujoco.model import build_world
from ibrobot_mujoco.options import CameraOptions, MujocoOptions
from ibrobot_mujoco.render import Renderer

_CAMERA = "arm_view"
_SEEN = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""A camera of MuJoCo's (x right, y up, looks along -z) in the frame of a mount (x ahead, y left, z up)."""


class ArmView:
    """Draws the arm in a camera of the robot. Create, use and close it in the same thread.

    The camera is that of the simulated scene, or else the one that `transform` and its calibration describe.

    Args:
        config: the robot.
        camera: name of the peripheral.
        info: what the camera says of itself; None if it says nothing.
        size: height and width of the pictures to draw [px].

    Raises:
        NotSupported: if the place of the camera, its calibration, a model of the arm, or a joint in it is missing; says
            which.
        HardwareError: if the simulated scene cannot be built.
        MissingDependency: if this machine cannot render.
    """

    def __init__(self, config: RobotConfig, camera: str, info: CameraInfo | None, size: tuple[int, int]) -> None:
        simulation = config.simulation.options if config.simulated and config.simulation is not None else None
        if isinstance(simulation, MujocoOptions):
            model, number = _in_scene(config, camera, simulation)
        else:
            model, number = _mounted(config, camera, info)
        self._model, self._data = model, mujoco.MjData(model)
        self._joints = [int(model.joint(name).qposadr[0]) for name in config.robot.joint_names]
        links = [int(model.jnt_bodyid[model.joint(name).id]) for name in config.robot.joint_names]
        owner = _carrier(model, int(model.cam_bodyid[number]), links)
        self.stands = owner == 0
        """Whether the camera stands beside the arm; otherwise it is on one of its links."""
        carriers = np.array([_carrier(model, int(body), links) for body in model.geom_bodyid])
        self._chosen = carriers != 0 if self.stands else carriers == owner
        self._renderer = Renderer(model, number, size[1], size[0], shadows=False)

    def moving(self, positions: Vector, room: float = 0.011) -> NDArray[np.bool_]:
        """Where something may move against the camera, shape (H, W).

        That is the arm without its base; for a camera on the arm, all except the link that carries it.

        Args:
            positions: of the joints [rad], shape (J,).
            room: around what is drawn, in relation to the width of the picture.
        """
        self._data.qpos[self._joints] = positions
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        geoms = self._renderer.render_geoms(self._data)
        seen = (geoms >= 0) & self._chosen[np.maximum(geoms, 0)]
        wide = _widened(seen, max(1, round(room * seen.shape[1])))
        return wide if self.stands else ~wide

    def close(self) -> None:
        """Release the renderer. Safe to call twice."""
        self._renderer.close()


def _in_scene(config: RobotConfig, camera: str, options: MujocoOptions) -> tuple[mujoco.MjModel, int]:
    model = build_world(options, config.robot, visual=True)[0].model
    peripheral = config.peripherals[camera].options
    if not isinstance(peripheral, CameraOptions):
        raise NotSupported(f"camera {camera} is not one of the scene")
    return model, find_camera(model, peripheral, camera)


def _mounted(config: RobotConfig, camera: str, info: CameraInfo | None) -> tuple[mujoco.MjModel, int]:
    mount, path = config.peripherals[camera].transform, config.robot.description.mjcf
    if path is None:
        raise NotSupported(f"robot {config.robot.name} has no MJCF to draw: set robot.description.mjcf")
    if mount is None:
        raise NotSupported(f"it is unknown where camera {camera} is: set its `transform`")
    if info is None or not info.k[4] > 0:
        raise NotSupported(f"camera {camera} is not calibrated: set its `info`, the file of a calibration")
    try:
        spec = several_arms(path, arms) if (arms := config.robot.description.arms) else read_mjcf(path).spec.copy()
    except KinematicsError as error:
        raise NotSupported(str(error)) from None
    known = [joint.name for joint in spec.joints]
    if missing := [name for name in config.robot.joint_names if name not in known]:
        raise NotSupported(f"{path} has no joint {missing[0]!r}; it has: {', '.join(known) or 'none'}")
    try:
        body, link = _carried(spec, path, config, mount.parent)
    except KinematicsError as error:
        raise NotSupported(f"camera {camera}: {error}") from None
    placed = link @ homogeneous(_rotation(mount) @ _SEEN, np.array(mount.xyz))
    fovy = math.degrees(2 * math.atan(info.height / 2 / float(info.k[4])))
    body.add_camera(name=_CAMERA, pos=placed[:3, 3], quat=np.roll(quaternion(placed[:3, :3]), 1), fovy=fovy)
    try:
        model = spec.compile()
    except ValueError as error:
        raise NotSupported(f"{path} does not compile: {error}") from None
    return model, int(model.camera(_CAMERA).id)


def _carried(
    spec: mujoco.MjSpec, path: Path, config: RobotConfig, parent: str
) -> tuple[mujoco.MjsBody, NDArray[np.float64]]:
    """The body that is the parent of a mount or carries this link of the URDF, and the link in it, shape (4, 4).

    Raises:
        KinematicsError: if there is no such body and link.
    """
    if parent in ("world", _base(spec)):
        return spec.worldbody, np.eye(4)
    if (body := spec.body(parent)) is not None:
        return body, np.eye(4)
    bodies = ", ".join(each.name for each in spec.bodies)
    urdf = read_urdf(config.robot.description.urdf) if config.robot.description.urdf is not None else None
    if urdf is None or parent not in urdf.links:
        raise KinematicsError(f"its parent {parent} is neither a link nor a body of the MJCF; bodies: {bodies}")
    # Links and bodies have names of their own; joints, and the place of the base, are the same in both.
    chain = Chain(urdf, config.robot.joint_names, urdf.root, parent)
    link = chain.pose(np.zeros(len(config.robot.joint_names)))
    if not chain.names:
        return spec.worldbody, link
    body = spec.joint(chain.names[-1]).parent
    model = Mjcf(path, spec).skeleton
    data = mujoco.MjData(model)
    data.qpos[[int(model.joint(name).qposadr[0]) for name in config.robot.joint_names]] = 0.0
    mujoco.mj_kinematics(model, data)
    at = int(model.body(body.name).id)
    placed = homogeneous(data.xmat[at].reshape(3, 3), data.xpos[at])
    return body, np.asarray(np.linalg.inv(placed) @ link)


def _base(spec: mujoco.MjSpec) -> str:
    """The name of the robot's base, which is where the world is."""
    return next((each.name for each in spec.bodies if each.name != "world"), "world")


def _rotation(mount: Mount) -> NDArray[np.float64]:
    if mount.quaternion is not None:
        return from_quaternion(mount.quaternion)
    return from_rpy(*(mount.rpy or (0.0, 0.0, 0.0)))


def _carrier(model: mujoco.MjModel, body: int, links: list[int]) -> int:
    """The link to which a body is fixed; 0 for what no joint moves."""
    while body and body not in links:
        body = int(model.body_parentid[body])
    return body


def _widened(chosen: NDArray[np.bool_], by: int) -> NDArray[np.bool_]:
    """A picture's part with `by` pixels around it."""
    for axis in (0, 1):
        padded = np.pad(chosen, [(by + 1, by) if i == axis else (0, 0) for i in (0, 1)])
        sums = np.cumsum(padded, axis=axis, dtype=np.int64)
        size = chosen.shape[axis]
        high, low = (np.take(sums, range(start, start + size), axis) for start in (2 * by + 1, 0))
        chosen = high > low
    return chosen

"""Kinematic models from MJCF files.

MuJoCo reads the file, since its compiler resolves defaults, includes, frames and orientations.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import attrs
import numpy as np

from ibrobot_core.api import Robot, Vector
from ibrobot_kinematics.errors import KinematicsError
from ibrobot_kinematics.model import ChainJoint, KinematicModel, TipPose
from ibrobot_kinematics.rotations import from_quaternion

_SLIDE, _HINGE = 2, 3
"""Values of mujoco.mjtJoint."""


def robot_model(robot: Robot, joints: Sequence[str] | None = None) -> KinematicModel:
    """The kinematic model of a robot's tip, within the robot's joint limits.

    Args:
        robot: its description has the MJCF and the tip, a site in it.
        joints: the joints that may move, in the order of vectors; None: all of the robot's. Others stay at zero. If
            the robot has several arms, the joints of one of them; the base frame is then that of the arm.

    Raises:
        KinematicsError: if the description has no MJCF, the MJCF cannot be read or lacks the tip or a joint, or the
            joints belong to several arms.
        KeyError: for a name in `joints` that is not a joint of the robot.
    """
    description = robot.description
    if description.mjcf is None:
        raise KinematicsError(f"robot {robot.name!r} has no robot.description.mjcf; kinematics needs a MuJoCo model")
    names = robot.joint_names if joints is None else tuple(joints)
    order = robot.indices(names)
    lower, upper = robot.lower[order], robot.upper[order]
    arms = list(dict.fromkeys(map(description.arm_of, names)))
    if len(arms) > 1:
        known = ", ".join(map(repr, arms))
        raise KinematicsError(f"robot {robot.name!r} has several arms ({known}), each with a tool: choose one of them")
    own = [name.removeprefix(arm) for arm in arms for name in names]
    try:
        model = read_mjcf(description.mjcf, description.tip, own, lower=lower, upper=upper)
    except KinematicsError as error:
        raise KinematicsError(f"robot.description: {error}") from error
    return attrs.evolve(model, joint_names=names)


def read_mjcf(
    path: Path, tip: str, joints: Sequence[str], *, lower: Vector | None = None, upper: Vector | None = None
) -> KinematicModel:
    """The kinematic model of a site in an MJCF.

    Args:
        path: the MJCF.
        tip: name of the site.
        joints: names of the joints that may move, in the order of vectors. Others stay at their reference position.
        lower: lower position limits [rad or m], shape (J,); None: those of the MJCF.
        upper: upper position limits [rad or m], shape (J,); None: those of the MJCF.

    Raises:
        KinematicsError: if the file cannot be read or lacks the site or a joint, if a joint is neither a hinge nor a
            slide or has no limits, or if the tip moves with a free or ball joint.
    """
    model = _compiled(path)
    sites = {model.site(i).name: i for i in range(model.nsite)}
    known = {model.joint(i).name: i for i in range(model.njnt)}
    if tip not in sites:
        raise KinematicsError(f"{path} has no site {tip!r}; it has: {', '.join(sites)}")
    for name in joints:
        if name not in known:
            raise KinematicsError(f"{path} has no joint {name!r}; it has: {', '.join(known)}")
        if model.jnt_type[known[name]] not in (_SLIDE, _HINGE):
            raise KinematicsError(f"{path}: joint {name!r} is neither a hinge nor a slide")
        if (lower is None or upper is None) and not model.jnt_limited[known[name]]:
            raise KinematicsError(f"{path}: joint {name!r} has no limits")
    ids = [known[name] for name in joints]
    chain, tip_pose = _chain(model, sites[tip], {joint: index for index, joint in enumerate(ids)}, path)
    return KinematicModel(
        tuple(joints),
        model.jnt_range[ids, 0].copy() if lower is None else lower,
        model.jnt_range[ids, 1].copy() if upper is None else upper,
        chain,
        tip,
        tip_pose,
    )


def _compiled(path: Path) -> Any:
    """The MJCF without its shapes, which take a second to load and do not matter here."""
    import mujoco

    try:
        spec = mujoco.MjSpec.from_file(str(path))
        for element in (*spec.sensors, *spec.pairs, *spec.geoms, *spec.meshes, *spec.materials, *spec.textures):
            spec.delete(element)
        # Only the compiler needs a mass of each body, which may have come from its shapes.
        spec.compiler.boundmass = spec.compiler.boundinertia = 1e-6
        for joint in spec.joints:
            joint.armature = 1.0
        return spec.compile()
    except ValueError as error:
        raise KinematicsError(f"{path} cannot be loaded: {error}") from error


def _chain(model: Any, site: int, order: dict[int, int], path: Path) -> tuple[tuple[ChainJoint, ...], TipPose]:
    """The joints of `order` (joint id -> index) from the base to a site, and the site in the last one's frame."""
    bodies = [int(model.site_bodyid[site])]
    while bodies[-1] != 0:
        bodies.append(int(model.body_parentid[bodies[-1]]))
    chain = []
    # The frame so far, in that of the last joint.
    position, rotation = np.zeros(3), np.eye(3)
    for body in reversed(bodies):
        position = position + rotation @ model.body_pos[body]
        rotation = rotation @ _rotation(model.body_quat[body])
        first = int(model.body_jntadr[body])
        for joint in range(first, first + int(model.body_jntnum[body])):
            if model.jnt_type[joint] not in (_SLIDE, _HINGE):
                raise KinematicsError(f"{path}: the tip moves with {model.joint(joint).name!r}, a free or ball joint")
            if joint not in order:
                continue
            anchor = model.jnt_pos[joint].copy()
            chain.append(
                ChainJoint(
                    index=order[joint],
                    position=position + rotation @ anchor,
                    rotation=rotation,
                    axis=model.jnt_axis[joint].copy(),
                    reference=float(model.qpos0[model.jnt_qposadr[joint]]),
                    slides=bool(model.jnt_type[joint] == _SLIDE),
                )
            )
            position, rotation = -anchor, np.eye(3)
    return tuple(chain), TipPose(
        position + rotation @ model.site_pos[site], rotation @ _rotation(model.site_quat[site])
    )


def _rotation(quaternion: Vector) -> Vector:
    """The matrix of MuJoCo's quaternion (w, x, y, z)."""
    return from_quaternion(np.roll(quaternion, -1))

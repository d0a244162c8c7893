"""The robot's shapes for the page: bodies, joints, primitives and low-poly meshes, from its MJCF or URDF.

The page computes where the bodies are, so that states need only contain the positions of joints.
"""

from __future__ import annotations

import base64
import logging
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from ibrobot_kinematics.errors import KinematicsError
from ibrobot_kinematics.meshes import cluster
from ibrobot_kinematics.mjcf import Mjcf, read_mjcf, several_arms
from ibrobot_kinematics.rotations import from_quaternion, from_rpy, quaternion
from ibrobot_kinematics.urdf import read_urdf
from numpy.typing import NDArray

_GRID_M = 0.0035
"""Grid on which the vertices of meshes are merged, for robots of up to 1 m; larger ones have a larger one."""
_SHOWN_GROUPS = 3
"""MuJoCo's viewers show geoms of the groups 0 to 2; files have collision shapes in group 3."""
_SHAPES = {
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{name.upper()}")): name
    for name in ("plane", "sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh")
}
_JOINTS = {int(mujoco.mjtJoint.mjJNT_HINGE): "hinge", int(mujoco.mjtJoint.mjJNT_SLIDE): "slide"}
_FIELD_DEG = 45.0
"""Vertical field of view of cameras that the robot YAML mounts, whose own is not known [°]."""
_LOOKING = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""A camera that looks along the x axis of its frame, with z up, as MuJoCo has cameras: along -z, with y up."""
_log = logging.getLogger("ibrobot.web")
_MESH = int(mujoco.mjtGeom.mjGEOM_MESH)


def make_scene(description: Mapping[str, Any]) -> dict[str, Any]:
    """The shapes of a robot, as JSON.

    Args:
        description: `mjcf`, `urdf` and `xml` (paths, or the text of a scene), `tip`, the `arms` of which the model is
            one, and `mounts` of sensors.

    Returns:
        `bodies` (parents first), `meshes` (base64 of float32 vertices and uint32 faces), `tips` by the prefix of their
        arm, `cameras`, and `problem`: why there are no shapes.
    """
    model, problem = None, "the robot has no model: set robot.description.mjcf or robot.description.urdf"
    try:
        model = _compiled(description)
    except (KinematicsError, ValueError) as error:
        problem = " ".join(str(error).split())
    if model is None:
        return {"bodies": [], "meshes": [], "tips": {}, "problem": problem}
    known = [i for i in range(model.ngeom) if int(model.geom_type[i]) in _SHAPES]
    shown = [i for i in known if model.geom_group[i] < _SHOWN_GROUPS] or known
    meshes = sorted({int(model.geom_dataid[i]) for i in shown if model.geom_type[i] == _MESH})
    grid = _GRID_M * max(1.0, float(model.stat.extent))
    return {
        "bodies": [_body(model, body, [i for i in shown if model.geom_bodyid[i] == body], meshes)
                   for body in range(model.nbody)],
        "meshes": [_mesh(model, mesh, grid) for mesh in meshes],
        "tips": {prefix: _tip(model, f"{prefix}{description['tip']}") for prefix in description.get("arms") or ("",)},
        "cameras": [
            {"body": int(model.cam_bodyid[i]), "pos": model.cam_pos[i].tolist(), "quat": model.cam_quat[i].tolist(),
             "fovy": float(model.cam_fovy[i])}
            for i in range(model.ncam)
        ] + list(_mounted(model, description)),
        "extent": float(model.stat.extent),
        "centre": model.stat.center.tolist(),
        "problem": "",
    }  # fmt: skip


def _mounted(model: Any, description: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """The cameras that the robot YAML mounts. They look along the x axis of their frame, MuJoCo's along -z."""
    known = {str(each["frame"]): each for each in description.get("mounts") or ()}
    root = _root_link(description.get("urdf"))
    for each in known.values():
        if not each["camera"]:
            continue
        pos, rotation, frame = np.zeros(3), _LOOKING, each["frame"]
        for _ in range(len(known) + 1):  # from the camera to the body that carries it
            mount = known.get(frame)
            if mount is None:
                break
            given = mount["quaternion"]
            turn = from_quaternion(given) if given is not None else from_rpy(*mount["rpy"])
            pos, rotation, frame = turn @ pos + mount["xyz"], turn @ rotation, mount["parent"]
        body = 0 if frame == root else mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, frame)
        if body < 0:
            _log.warning("the page does not show where camera %s is: the model has no body %r", each["name"], frame)
            continue
        quat = np.roll(quaternion(rotation), 1)
        yield {"body": body, "pos": pos.round(5).tolist(), "quat": quat.round(5).tolist(), "fovy": _FIELD_DEG}


def _root_link(urdf: str | None) -> str | None:
    """The first link of a URDF that no joint carries: the base frame."""
    try:
        return read_urdf(Path(urdf)).root if urdf is not None else None
    except KinematicsError:
        return None


def _compiled(description: Mapping[str, Any]) -> Any:
    if description.get("xml"):
        return mujoco.MjModel.from_xml_string(description["xml"])
    path = description.get("mjcf") or description.get("urdf")
    if not path:
        return None
    arms = description.get("arms") or {}
    return (Mjcf(Path(path), several_arms(Path(path), arms)) if arms else read_mjcf(Path(path))).complete


def _body(model: Any, body: int, geoms: list[int], meshes: list[int]) -> dict[str, Any]:
    first = int(model.body_jntadr[body])
    joints = []
    for joint in range(first, first + int(model.body_jntnum[body])):
        kind = _JOINTS.get(int(model.jnt_type[joint]))
        if kind is not None:
            joints.append({
                "name": model.joint(joint).name, "type": kind, "axis": model.jnt_axis[joint].tolist(),
                "pos": model.jnt_pos[joint].tolist(), "ref": float(model.qpos0[model.jnt_qposadr[joint]]),
            })  # fmt: skip
    return {
        "name": model.body(body).name,
        "parent": int(model.body_parentid[body]) if body else -1,
        "pos": model.body_pos[body].tolist(),
        "quat": model.body_quat[body].tolist(),
        "joints": joints,
        "geoms": [_geom(model, geom, meshes) for geom in geoms],
    }


def _geom(model: Any, geom: int, meshes: list[int]) -> dict[str, Any]:
    kind = int(model.geom_type[geom])
    material = int(model.geom_matid[geom])
    rgba = model.mat_rgba[material] if material >= 0 else model.geom_rgba[geom]
    drawn: dict[str, Any] = {
        "type": _SHAPES[kind],
        "size": model.geom_size[geom].tolist(),
        "pos": model.geom_pos[geom].tolist(),
        "quat": model.geom_quat[geom].tolist(),
        "rgba": [round(float(value), 4) for value in rgba],
    }
    if kind == _MESH:
        drawn["mesh"] = meshes.index(int(model.geom_dataid[geom]))
    return drawn


def _mesh(model: Any, mesh: int, grid: float) -> dict[str, str]:
    start, size = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
    first, count = int(model.mesh_faceadr[mesh]), int(model.mesh_facenum[mesh])
    corners = model.mesh_vert[start : start + size].astype(np.float64)
    vertices, faces = cluster(corners[model.mesh_face[first : first + count]], grid)
    return {"vertices": _packed(vertices.astype("<f4")), "faces": _packed(faces.astype("<u4"))}


def _packed(values: NDArray[Any]) -> str:
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode()


def _tip(model: Any, name: str) -> dict[str, Any] | None:
    site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, name)
    if site >= 0:
        body, pos, quat = int(model.site_bodyid[site]), model.site_pos[site], model.site_quat[site]
        return {"body": body, "pos": pos.tolist(), "quat": quat.tolist()}
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
    return {"body": body, "pos": [0, 0, 0], "quat": [1, 0, 0, 0]} if body >= 0 else None

"""Arms for the tests, as MJCF: one with five or six joints, and random ones."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
from hypothesis import strategies as st
from ibrobot_kinematics import KinematicModel, TipPose, read_mjcf

from ibrobot_core.api import Vector

LINKS = {
    "pan": ("0 0 1", "0 0 0.05"),
    "lift": ("0 1 0", "0 0 0.05"),
    "elbow": ("0 1 0", "0.15 0 0"),
    "flex": ("0 1 0", "0.15 0 0"),
    "heading": ("0 0 1", "0.01 0 0"),
    "roll": ("1 0 0", "0.05 0 0"),
    "gripper": ("0 0 1", "0.03 0.01 0"),
}
"""Joint -> axis, and where its body is; with `heading` the arm has six."""
BENT = {"pan": 0.3, "lift": -0.6, "elbow": 1.1, "flex": 0.2, "heading": 0.1, "roll": 0.2, "gripper": 0.4}
FIVE = tuple(name for name in LINKS if name != "heading")
SIX = tuple(LINKS)


def write_arm(directory: Path, *joints: str) -> Path:
    """An arm of these joints; bodies weigh what their shapes say, and a cube lies beside it."""
    path = directory / "arm.xml"
    bodies = ""
    for name in joints:
        axis, position = LINKS[name]
        bodies += f'<body pos="{position}"><joint name="{name}" axis="{axis}" range="-1.6 1.6" limited="true"/>'
        bodies += '<geom size="0.01"/>'
        if name == joints[-2]:
            # The tool points along the arm: its z axis is the arm's x.
            bodies += '<site name="tool" pos="0.08 0 0" xyaxes="0 0 -1 0 1 0"/>'
    cube = '<body pos="1 0 0"><freejoint name="cube"/><geom size="0.01"/><site name="on the cube"/></body>'
    end = "</body>" * len(joints)
    path.write_text(f'<mujoco><compiler angle="radian"/><worldbody>{bodies}{end}{cube}</worldbody></mujoco>')
    return path


def bent(model: KinematicModel) -> Vector:
    """A configuration far from limits and singularities."""
    return np.array([BENT[name] for name in model.joint_names])


def by_mujoco(path: Path, model: KinematicModel, q: Vector) -> tuple[TipPose, Vector]:
    """The tip's pose and Jacobian as MuJoCo computes them."""
    whole = mujoco.MjModel.from_xml_path(str(path))
    state = mujoco.MjData(whole)
    for name, position in zip(model.joint_names, q, strict=True):
        state.joint(name).qpos[0] = position
    mujoco.mj_kinematics(whole, state)
    mujoco.mj_comPos(whole, state)
    linear, angular = np.zeros((3, whole.nv)), np.zeros((3, whole.nv))
    site = state.site(model.tip)
    mujoco.mj_jacSite(whole, state, linear, angular, site.id)
    order = [int(whole.joint(name).dofadr[0]) for name in model.joint_names]
    return TipPose(site.xpos.copy(), site.xmat.reshape(3, 3).copy()), np.vstack([linear, angular])[:, order]


_LENGTH = st.floats(-0.3, 0.3).map(lambda x: round(x, 4))
_TRIPLE = st.tuples(_LENGTH, _LENGTH, _LENGTH).map(lambda t: " ".join(map(str, t)))
_AXIS = st.sampled_from(["1 0 0", "0 1 0", "0 0 -1", "1 2 0.5", "-0.3 0.1 1"])
_ANGLES = st.tuples(*[st.integers(-180, 180)] * 3).map(lambda t: " ".join(map(str, t)))


@st.composite
def chains(draw: st.DrawFn) -> tuple[str, tuple[str, ...]]:
    """An MJCF of bodies with none to two joints each, hinges and slides, and the names of its joints."""
    names: list[str] = []
    bodies = ""
    count = draw(st.integers(1, 6))
    for _ in range(count):
        bodies += f'<body pos="{draw(_TRIPLE)}" euler="{draw(_ANGLES)}"><geom size="0.01"/>'
        for _ in range(draw(st.integers(0, 2))):
            names.append(f"j{len(names)}")
            kind, limits, reference = draw(st.sampled_from([("hinge", "-150 150", 20), ("slide", "-0.5 0.5", 0.1)]))
            bodies += f'<joint name="{names[-1]}" type="{kind}" axis="{draw(_AXIS)}" pos="{draw(_TRIPLE)}"'
            bodies += f' range="{limits}" ref="{draw(st.sampled_from([0, reference]))}" armature="1"/>'
    bodies += f'<site name="tip" pos="{draw(_TRIPLE)}" euler="{draw(_ANGLES)}"/>' + "</body>" * count
    compiler = f'<compiler angle="degree" eulerseq="{draw(st.sampled_from(["xyz", "ZYX"]))}"/>'
    return f"<mujoco>{compiler}<worldbody>{bodies}</worldbody></mujoco>", tuple(draw(st.permutations(names)))


def load(directory: Path, text: str, joints: tuple[str, ...]) -> tuple[Path, KinematicModel]:
    """The MJCF on disk, and its model."""
    path = directory / "chain.xml"
    path.write_text(text)
    return path, read_mjcf(path).chain("tip", joints)

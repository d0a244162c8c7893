"""Complete an MJCF for simulation and planning: drives where it has none, a tool, a pose without contacts."""

from __future__ import annotations

import math
import re
import shutil
from pathlib import Path

import mujoco
from ibrobot_kinematics.errors import KinematicsError
from ibrobot_kinematics.mjcf import read_mjcf, unusable

from ibrobot_core.api import HardwareError
from ibrobot_mujoco.chains import chains_of, parents_of
from ibrobot_mujoco.plausibility import Drive, check_plausible, loads
from ibrobot_mujoco.urdf_file import several
from ibrobot_mujoco.urdf_model import (
    EFFORT,
    FINGER,
    TIP,
    TURN_RAD,
    VELOCITY,
    DrivenJoint,
    RobotModel,
    add_servos,
    grips_of,
    mark_grippers,
    settle,
    write_model,
)

_MOVES = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)


def complete_model(mjcf: Path, folder: Path, tip: str | None = None) -> RobotModel:
    """Write `folder/model.xml` and the files that it needs.

    Args:
        mjcf: the MJCF of an arm.
        folder: a new folder.
        tip: site or body whose frame is that of the tool; by default the last site named like a tool, or the last
            body.

    Raises:
        HardwareError: if the file cannot be read, or describes no arm.
    """
    notes: list[str] = []
    try:
        spec = read_mjcf(mjcf).spec.copy()
        model = spec.compile()
    except KinematicsError as error:
        raise HardwareError(str(error)) from error
    except (ValueError, mujoco.FatalError) as error:
        raise HardwareError(str(unusable(mjcf, error))) from error
    folder.mkdir(parents=True)
    try:
        _copy_files(spec, mjcf, folder)
        for key in list(spec.keys):  # their sizes are those of the present drives
            spec.delete(key)
        joints, doubts = _drive(spec, model, notes)
        chains = chains_of(parents_of(model, [each.name for each in joints]), grips_of(joints))
        tool = _tool(spec, tip, notes)
        home = settle(spec, joints, notes, doubts)
        path = write_model(spec, folder)
    except BaseException:
        shutil.rmtree(folder)
        raise
    name = re.sub(r"\W+", "_", spec.modelname or mjcf.stem)
    return RobotModel(path, name, joints, chains, home, tuple(notes), tuple(doubts), tool)


def _copy_files(spec: mujoco.MjSpec, mjcf: Path, folder: Path) -> None:
    """Copy meshes and textures into the folder, without subfolders."""
    for inside, files in ((spec.meshdir, spec.meshes), (spec.texturedir, spec.textures)):
        for number, each in enumerate(files):
            if each.file:
                source = mjcf.parent / inside / each.file
                each.file = f"{number:02d}_{source.name}"
                shutil.copyfile(source, folder / each.file)
    spec.meshdir = spec.texturedir = "."
    spec.modelfiledir = str(folder)


def _drive(spec: mujoco.MjSpec, model: mujoco.MjModel, notes: list[str]) -> tuple[tuple[DrivenJoint, ...], list[str]]:
    """The joints that have a drive; position servos for motors, and for all joints if none has a drive."""
    drives = {each.target: each for each in spec.actuators if each.trntype == mujoco.mjtTrn.mjTRN_JOINT}
    moving = [each for each in spec.joints if each.type in _MOVES and (not drives or each.name in drives)]
    driven, missing, turning = [], [], []
    for joint in moving:
        if not joint.name:
            raise HardwareError("the MJCF has a joint without a name")
        mujoco_joint = model.joint(joint.name)
        lower, upper = map(float, mujoco_joint.range)
        if not model.jnt_limited[mujoco_joint.id]:
            lower, upper = -TURN_RAD, TURN_RAD
            turn = math.degrees(TURN_RAD) if spec.compiler.degree else TURN_RAD
            joint.limited, joint.range = True, [-turn, turn]
            turning.append(joint.name)
        driven.append(DrivenJoint(joint.name, lower, upper, VELOCITY, VELOCITY / 0.075, False))
        drive = drives.get(joint.name)
        if drive is None or drive.biastype != mujoco.mjtBias.mjBIAS_AFFINE:
            if drive is not None:
                spec.delete(drive)
            missing.append(joint.name)
    if not driven:
        raise HardwareError("the MJCF has no joint that moves an arm")
    joints = mark_grippers(driven, model)
    carried = loads(model, {each.name: (each.lower, each.upper) for each in joints})
    servos = [each for each in joints if each.name in missing]
    doubts = check_plausible(
        model, [Drive(each.name, EFFORT, VELOCITY, each.lower, each.upper) for each in servos], carried, {}
    )
    notes.append(f"The MJCF states no speeds: {VELOCITY:g} rad/s, and braking from it within 75 ms.")
    if servos:
        for body in spec.bodies[1:]:
            body.gravcomp = 1
        add_servos(spec, model, servos, dict.fromkeys(missing, EFFORT), carried[1])
        notes.append(
            f"Position servos of 8 Hz and {EFFORT:g} N m, which hold the arm's weight (gravcomp), drive "
            f"{several(missing)}."
        )
    if turning:
        notes.append(f"Without end in the MJCF, here one turn to each side: {several(turning)}.")
    if grips := grips_of(joints):
        notes.append(f"The gripper, by names and short ways: {several(grips)}.")
    return tuple(joints), doubts


def _tool(spec: mujoco.MjSpec, tip: str | None, notes: list[str]) -> str:
    """The name of a site at the tool."""
    sites = [each.name for each in spec.sites if each.name]
    bodies = [each.name for each in spec.bodies[1:] if each.name]
    if tip is None:
        fingers = {each.name for each in spec.bodies for joint in each.joints if FINGER.search(joint.name)}
        still = [name for name in bodies if name not in fingers]
        if not still:
            raise HardwareError("the MJCF has no body with a name: give one to the body of the tool")
        named = [name for name in still if TIP.search(name)]
        named += [name for name in sites if TIP.search(name) or FINGER.search(name)]
        tip = named[-1] if named else still[-1]
        notes.append(f"The tool is the frame of {tip}; --tip NAME sets another site or body.")
    if tip in sites:
        return tip
    if tip not in bodies:
        raise HardwareError(f"the MJCF has no site or body {tip!r}; it has: {', '.join((*bodies, *sites))}")
    spec.body(tip).add_site(name="ibrobot_tip")
    return "ibrobot_tip"

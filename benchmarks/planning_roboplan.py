"""roboplan's own pipeline on the problems of `planning.py`: RRT-Connect, shortcuts, TOPPRA.

roboplan has no padding: the scene's objects are larger by it.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import coal
import numpy as np
from ibrobot_kinematics.poses import matrix
from ibrobot_planning.planners.timing import Motion
from ibrobot_planning.world.objects import Box, Cylinder, World
from planning_scenes import ARM_JOINTS, JOINTS, MAX_ACCELERATION, MAX_VELOCITY, PADDING_M, Maker, Problem, so101
from roboplan.core import (
    JointConfiguration,
    PathShortcutter,
    PathShortcuttingOptions,
    Scene,
    loadJointLimitsConfig,
    loadUrdfSceneDescription,
)
from roboplan.rrt import RRT, RRTOptions
from roboplan.toppra import PathParameterizerTOPPRA, SplineFittingMode, TOPPRAOptions

from ibrobot_core.api import Vector

GROUP = "arm"


def _rpy(rotation: Vector) -> str:
    level = np.hypot(rotation[0, 0], rotation[1, 0])
    pitch = np.arctan2(-rotation[2, 0], level)
    if level < 1e-6:  # straight up or down: roll and yaw turn about the same axis
        roll, yaw = np.arctan2(-rotation[1, 2], rotation[1, 1]), 0.0
    else:
        roll, yaw = np.arctan2(rotation[2, 1], rotation[2, 2]), np.arctan2(rotation[1, 0], rotation[0, 0])
    return f"{roll:.9f} {pitch:.9f} {yaw:.9f}"


def _origin(placed: Vector) -> str:
    x, y, z = placed[:3, 3]
    return f'<origin xyz="{x:.9f} {y:.9f} {z:.9f}" rpy="{_rpy(placed[:3, :3])}"/>'


def _collision(placed: Vector, shape: str) -> str:
    return f"<collision>{_origin(placed)}<geometry>{shape}</geometry></collision>"


def _shape(geometry: Any, folder: Path, name: str) -> str:
    if isinstance(geometry, coal.Box):
        x, y, z = 2 * geometry.halfSide
        return f'<box size="{x} {y} {z}"/>'
    if isinstance(geometry, coal.Sphere):
        return f'<sphere radius="{geometry.radius}"/>'
    if isinstance(geometry, coal.Capsule):
        return f'<cylinder radius="{geometry.radius}" length="{2 * (geometry.halfLength + geometry.radius)}"/>'
    path = folder / f"{name}.obj"
    corners = np.array(geometry.points())
    faces = [geometry.polygons(i) for i in range(geometry.num_polygons)]
    lines = ["v {} {} {}".format(*corner) for corner in corners]
    path.write_text("\n".join(lines + [f"f {f[0] + 1} {f[1] + 1} {f[2] + 1}" for f in faces]) + "\n")
    return f'<mesh filename="{path}"/>'


def _padded(world: World) -> str:
    parts = []
    for thing in world.objects.values():
        shape = thing.shape
        if isinstance(shape, Box):
            x, y, z = (each + 2 * PADDING_M for each in shape.size)
            parts.append(_collision(matrix(thing.pose), f'<box size="{x} {y} {z}"/>'))
        else:
            assert isinstance(shape, Cylinder)
            size = f'radius="{shape.radius + PADDING_M}" length="{shape.height + 2 * PADDING_M}"'
            parts.append(_collision(matrix(thing.pose), f"<cylinder {size}/>"))
    return "".join(parts)


def scene(maker: Maker, world: World, folder: Path) -> Scene:
    """The arm in a world, as roboplan has it; all joints of the SO-101 turn about their z axis."""
    arm, robot = maker.arm, so101()
    model, links = arm.model, {number: "" for number in range(arm.model.njoints)}
    for i, shape in enumerate(arm.shapes):
        links[shape.joint] += _collision(shape.placement, _shape(shape.geometry, folder, f"s{i}"))
    xml = [f'<link name="l{number}">{parts}</link>' for number, parts in links.items()]
    xml.append(f'<link name="scene">{_padded(world)}</link>')
    xml.append('<joint name="fixed" type="fixed"><parent link="l0"/><child link="scene"/></joint>')
    for number in range(1, model.njoints):
        limit = robot.joints[JOINTS.index(model.names[number])]
        xml.append(
            f'<joint name="{model.names[number]}_joint" type="revolute"><parent link="l{model.parents[number]}"/>'
            f'<child link="l{number}"/>{_origin(model.jointPlacements[number].homogeneous)}<axis xyz="0 0 1"/>'
            f'<limit lower="{limit.lower}" upper="{limit.upper}" velocity="{MAX_VELOCITY}" effort="10"/></joint>'
        )
    urdf = folder / "arm.urdf"
    urdf.write_text(f'<robot name="so101">{"".join(xml)}</robot>')
    made = Scene("so101", loadUrdfSceneDescription(urdf))
    for number in range(1, model.njoints):
        made.setCollisions(f"l{number}", f"l{model.parents[number]}", False)
    made.addGroup(GROUP, [f"{name}_joint" for name in ARM_JOINTS])
    limits = folder / "limits.yaml"
    lines = "".join(f"    {name}_joint:\n      max_acceleration: [{MAX_ACCELERATION}]\n" for name in JOINTS)
    limits.write_text(f"joint_limits:\n{lines}")
    made.importJointLimitsFromConfig(loadJointLimitsConfig(limits))
    return made


def made(maker: Maker, world: World) -> Scene:
    """A scene whose files are gone again."""
    with tempfile.TemporaryDirectory() as folder:
        return scene(maker, world, Path(folder))


def plan(made: Scene, task: Problem, seconds: float) -> Motion:
    """One plan, as roboplan's examples do it.

    Raises:
        RuntimeError: where roboplan finds none.
    """
    names = [f"{name}_joint" for name in ARM_JOINTS]
    made.setJointPositions(np.zeros(len(JOINTS)))
    start, goal = JointConfiguration(), JointConfiguration()
    start.joint_names = goal.joint_names = names
    start.positions, goal.positions = task.start, task.goal
    options = RRTOptions(group_name=GROUP, max_nodes=100_000, max_planning_time=seconds, rrt_connect=True)
    path = RRT(made, options).plan(start, goal)
    shortcutting = PathShortcuttingOptions(group_name=GROUP)
    path = PathShortcutter(made, shortcutting).shortcut(path)
    timing = TOPPRAOptions()
    timing.mode = SplineFittingMode.Adaptive
    trajectory = PathParameterizerTOPPRA(made, GROUP).generate(path, timing)
    states = (np.array(each) for each in (trajectory.positions, trajectory.velocities, trajectory.accelerations))
    return Motion(np.array(trajectory.times), *states)

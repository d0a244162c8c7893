"""An arm for the tests: a base without collision geometry, a pan, three parallel joints, a roll, and a jaw."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

from ibrobot_planning.planners.options import RrtConnectOptions
from ibrobot_planning.planners.rrt import RrtConnectPlanner
from ibrobot_planning.world.objects import Box, World, WorldObject

from ibrobot_core.api import Context, Description, Joint, Pose, Robot, SteppedClock, Vector3

ARM = ("pan", "lift", "elbow", "flex", "roll")
JOINTS = (*ARM, "jaw")
MJCF = """<mujoco><compiler angle="radian"/>
<asset><mesh name="foot" vertex="-.05 -.05 0  .05 -.05 0  -.05 .05 0  .05 .05 0  0 0 .04"/></asset>
<worldbody><body name="base"><geom type="mesh" mesh="foot" contype="0" conaffinity="0"/>
<body name="turret" pos="0 0 .05"><joint name="pan" axis="0 0 1" range="-2 2"/><geom type="cylinder" size=".02 .02"/>
<body name="upper" pos="0 0 .04"><joint name="lift" axis="0 1 0" range="-1.8 1.8"/>
<geom type="capsule" fromto="0 0 .03 0 0 .12" size=".012"/>
<body name="lower" pos="0 0 .14"><joint name="elbow" axis="0 1 0" range="-2.2 2.2"/>
<geom type="box" pos="0 0 .07" size=".01 .012 .05"/>
<body name="wrist" pos="0 0 .14"><joint name="flex" axis="0 1 0" range="-1.8 1.8"/>
<geom type="box" pos="0 0 .02" size=".01 .01 .01"/>
<body name="hand" pos="0 0 .04"><joint name="roll" axis="0 0 1" range="-2.7 2.7"/>
<geom type="box" pos="-.012 0 .03" size=".004 .01 .025"/><site name="tip" pos="0 0 .06"/>
<body name="finger" pos=".012 0 .01"><joint name="jaw" axis="0 1 0" range="-.2 1.2"/>
<geom type="sphere" pos="0 0 .035" size=".006"/>
</body></body></body></body></body></body></body>{objects}</worldbody></mujoco>"""
LIMITS = {"pan": 2.0, "lift": 1.8, "elbow": 2.2, "flex": 1.8, "roll": 2.7}


def write_arm(folder: Path, objects: str = "") -> Path:
    """The MJCF, with further objects in its world."""
    path = folder / "arm.xml"
    path.write_text(MJCF.format(objects=objects))
    return path


def make_robot(folder: Path) -> Robot:
    joints = [Joint(name, -limit, limit, max_velocity=3.0, max_acceleration=10.0) for name, limit in LIMITS.items()]
    joints.append(Joint("jaw", -0.2, 1.2, max_velocity=3.0, max_acceleration=10.0))
    poses = {"up": (0.0,) * 6, "left": (1.0, 0.8, 0.8, 0.5, 0.0, 0.0), "right": (-1.0, 0.8, 0.8, 0.5, 0.0, 0.0)}
    return Robot(
        name="tabletop",
        joints=tuple(joints),
        groups={"arm": ARM, "gripper": ("jaw",)},
        description=Description(mjcf=write_arm(folder), tip="tip", poses=poses),
    )


def make_planner(folder: Path, world: World | None = None, seed: int = 0, **options: Any) -> RrtConnectPlanner:
    """A loaded planner with a world of its own; a slow machine does not end its searches."""
    context = Context("planner", SteppedClock(7), logging.getLogger("test"), make_robot(folder), seed=seed)
    planner = RrtConnectPlanner(RrtConnectOptions(**{"planning_time": 300.0, **options}), context)
    planner.load()
    planner.world = world or World()
    return planner


def box(x: float, y: float, z: float, *size: float) -> WorldObject:
    return WorldObject(Box(size), Pose(Vector3(x, y, z)))


WALL = World({"wall": box(0.2, 0, 0.15, 0.3, 0.02, 0.3)})
"""Between the poses `left` and `right`."""

"""Make `plan_KIND.webp`, a picture of each kind of scene with a path through it.

    uv run --with pillow python docs/images/make_planning.py

Shows the arm at the start, in the middle and at the goal, and where the tool passes.
"""

from __future__ import annotations

import logging
import sys
from pathlib import Path

import mujoco
import numpy as np
from ibrobot_kinematics.poses import matrix
from ibrobot_planning.planner import JointGoal, PlanRequest
from ibrobot_planning.planners.options import RrtConnectOptions
from ibrobot_planning.planners.rrt import RrtConnectPlanner
from ibrobot_planning.planners.timing import motion_of
from ibrobot_planning.world.objects import Box, Cylinder, World
from PIL import Image

from ibrobot_core.api import Context, SteppedClock, Vector

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from planning_scenes import ARM_JOINTS, KINDS, MJCF, Maker, so101

SIZE = (480, 360)
SEEDS = {"table_pick": 4, "under_table": 0, "box": 3, "bookshelf": 2, "cage": 2}
AZIMUTHS = {"table_pick": 150, "under_table": 150, "box": 150, "bookshelf": 40, "cage": 60}
SHARES = (0.0, 0.5, 1.0)


def scene(world: World) -> mujoco.MjModel:
    """The arm as one sees it, with the world."""
    spec = mujoco.MjSpec.from_file(str(MJCF))
    spec.visual.global_.offwidth, spec.visual.global_.offheight = SIZE
    spec.visual.headlight.ambient = [0.45] * 3
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[1, 1, 1],
        rgb2=[0.9, 0.93, 0.96],
        width=64,
        height=384,
    )
    spec.worldbody.add_light(pos=[0.3, -0.3, 1.2], dir=[-0.1, 0.3, -1])
    for name, thing in world.objects.items():
        placed, quaternion, shape = matrix(thing.pose), np.zeros(4), thing.shape
        mujoco.mju_mat2Quat(quaternion, placed[:3, :3].ravel())
        kind = mujoco.mjtGeom.mjGEOM_BOX if isinstance(shape, Box) else mujoco.mjtGeom.mjGEOM_CYLINDER
        if isinstance(shape, Box):
            size = [each / 2 for each in shape.size]
        else:
            assert isinstance(shape, Cylinder)
            size = [shape.radius, shape.height / 2, 0]
        colour = [0.85, 0.85, 0.82, 1] if name == "table" else [0.35, 0.55, 0.75, 0.55]
        spec.worldbody.add_geom(type=kind, size=size, pos=placed[:3, 3], quat=quaternion, rgba=colour)
    return spec.compile()


def picture(model: mujoco.MjModel, positions: Vector, azimuth: float) -> Image.Image:
    """The scene along a motion, shape (N, 5), seen from `azimuth` [degrees]."""
    data = mujoco.MjData(model)
    columns = [model.joint(name).qposadr[0] for name in ARM_JOINTS]
    tips = []
    for q in positions:
        data.qpos[columns] = q
        mujoco.mj_kinematics(model, data)
        tips.append(data.site("gripperframe").xpos.copy())
    camera = mujoco.MjvCamera()
    camera.lookat[:], camera.distance, camera.azimuth, camera.elevation = (0.17, 0, 0.14), 0.8, azimuth, -25
    options = mujoco.MjvOption()
    options.geomgroup[:] = [1, 1, 1, 0, 0, 0]
    images = []
    with mujoco.Renderer(model, SIZE[1], SIZE[0]) as renderer:
        for share in SHARES:
            data.qpos[columns] = positions[round(share * (len(positions) - 1))]
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, camera, options)
            for tip in tips[:: max(len(tips) // 80, 1)]:
                geom = renderer.scene.geoms[renderer.scene.ngeom]
                red = np.array([0.85, 0.15, 0.1, 1], dtype=np.float32)
                mujoco.mjv_initGeom(geom, mujoco.mjtGeom.mjGEOM_SPHERE, np.full(3, 0.003), tip, np.eye(3).ravel(), red)
                renderer.scene.ngeom += 1
            images.append(renderer.render().astype(float))
    return Image.fromarray(np.mean(images, axis=0).astype(np.uint8))


def main() -> None:
    """Plan and draw one problem of each kind."""
    maker = Maker()
    context = Context("planner", SteppedClock(0), logging.getLogger("planner"), so101())
    planner = RrtConnectPlanner(RrtConnectOptions(), context)
    planner.load()
    for kind in KINDS:
        problem = maker.problem(kind, SEEDS[kind])
        planner.world = problem.world
        result = planner.plan(PlanRequest(ARM_JOINTS, problem.start, JointGoal(ARM_JOINTS, problem.goal)))
        out = Path(__file__).with_name(f"plan_{kind}.webp")
        motion = motion_of(result.trajectory)
        assert motion is not None
        picture(scene(problem.world), motion.sampled(0.01)[0], AZIMUTHS[kind]).save(out, quality=70, method=6)
        print(f"{out}: {out.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()

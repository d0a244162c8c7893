"""Make `middle_pose.webp`, the pose for calibration: `uv run --with pillow python docs/images/make_middle_pose.py`."""

from __future__ import annotations

from pathlib import Path

import mujoco
from PIL import Image

from ibrobot_core.app import find_config, installed_plugins, load_config

SIZE = (420, 360)
VIEWS = ((150.0, -12.0), (90.0, -5.0))
"""Azimuth and elevation of each picture [degrees]: from the front at the left, and from the side."""


def main() -> None:
    """Render the arm with every joint in the middle of its range, twice, side by side."""
    config = load_config(find_config("so101", installed_plugins()), sim=True)
    spec = mujoco.MjSpec.from_file(str(config.robot.description.mjcf))
    spec.visual.global_.offwidth, spec.visual.global_.offheight = SIZE
    spec.visual.headlight.ambient = (0.45, 0.45, 0.45)
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
        rgb1=(1, 1, 1),
        rgb2=(1, 1, 1),
        width=8,
        height=8,
    )
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=(2, 2, 0.1), rgba=(0.93, 0.93, 0.95, 1))
    model = spec.compile()
    data = mujoco.MjData(model)
    data.joint("gripper").qpos = sum(model.joint("gripper").range) / 2
    mujoco.mj_forward(model, data)
    picture = Image.new("RGB", (SIZE[0] * len(VIEWS), SIZE[1]))
    with mujoco.Renderer(model, SIZE[1], SIZE[0]) as renderer:
        for i, (azimuth, elevation) in enumerate(VIEWS):
            camera = mujoco.MjvCamera()
            camera.lookat[:] = (0.18, 0.0, 0.14)
            camera.distance, camera.azimuth, camera.elevation = 0.6, azimuth, elevation
            renderer.update_scene(data, camera)
            picture.paste(Image.fromarray(renderer.render()), (i * SIZE[0], 0))
    out = Path(__file__).with_name("middle_pose.webp")
    picture.save(out, quality=70, method=6)
    print(f"{out}: {out.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()

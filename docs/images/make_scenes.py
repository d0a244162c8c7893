"""Make `scenes.webp`, a picture of each scene at work: `uv run --with pillow python docs/images/make_scenes.py`.

Each picture shows the first success or, for scenes whose last step looks like the first, the middle of an episode.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from ibrobot_core.app import LaunchRequest, Runtime, Session, installed_plugins, load_config
from ibrobot_core.config import find_config

SIZE = (320, 240)
TOPIC = "/camera/front/image_raw"
CAMERA = "{name: front, kind: camera, type: mujoco, width: 320, height: 240, fps: 30, encoding: raw, shadows: true}"
SCENES = {
    "pick_cube": ("so101_scenes", 3.3),
    "push": ("so101_scenes", 3.2),
    "stack": ("so101_scenes", 3.6),
    "sort": ("so101_scenes", 6.3),
    "drawer": ("so101_scenes", 3.6),
    "handover": ("bi_so101_handover", 7.8),
}
"""Scene -> robot YAML, and when the picture is taken [s]."""


def picture(scene: str, config: str, time_s: float) -> Image.Image:
    """The scene at a time of its first episode."""
    registry = installed_plugins()
    overrides = [f"simulation.scene={scene}", f"peripherals=[{CAMERA}]"]
    robot = load_config(find_config(config, registry), sim=True, mode=scene, overrides=overrides)
    session = Session(robot, registry, LaunchRequest(lockstep=True, episodes=1))
    images = session.bus.subscribe(TOPIC, 1)
    runtime = Runtime(session)
    runtime.start()
    while not runtime.step() and session.clock.now_ns() < time_s * 1e9:
        pass
    (received,) = images.drain()
    images.close()
    runtime.stop()
    runtime.raise_failure()
    return Image.fromarray(np.asarray(received.message.data).reshape(SIZE[1], SIZE[0], 3))


def main() -> None:
    """Write the picture."""
    pictures = [picture(scene, *given) for scene, given in SCENES.items()]
    columns = 3
    rows = -(-len(pictures) // columns)
    sheet = Image.new("RGB", (columns * SIZE[0], rows * SIZE[1]), "white")
    for i, each in enumerate(pictures):
        sheet.paste(each, (i % columns * SIZE[0], i // columns * SIZE[1]))
    out = Path(__file__).with_name("scenes.webp")
    sheet.save(out, quality=70, method=6)
    print(f"{out}: {out.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()

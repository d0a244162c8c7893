"""Make `pick.webp`, the animated picture of the pick: `uv run --with pillow python docs/images/make_pick.py`.

Records one episode of the scripted pick in simulation, seen by the scene's camera `front`, and keeps every third image.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

from ibrobot_core.plugins import installed_plugins

SIZE = (480, 360)
TOPIC = "/camera/front/image_raw"
CAMERA = "{name: front, kind: camera, type: mujoco, width: 480, height: 360, fps: 30, encoding: raw, shadows: true}"
KEPT = 3
"""Of three images one is kept: 10 Hz."""


def main() -> None:
    """Record the episode and write the picture."""
    with tempfile.TemporaryDirectory() as folder:
        command = [
            Path(sys.executable).with_name("ibrobot"),
            "record",
            "so101_blind",
            "--sim",
            "--lockstep",
            "--headless",
        ]
        settings = [f"peripherals=[{CAMERA}]", "recording={type: mcap, topics: all}"]
        overrides = [word for setting in settings for word in ("--set", setting)]
        subprocess.run([*command, *overrides, "--episodes", "1", "--root", folder, "--dataset", "pick"], check=True)
        reader = installed_plugins().open_episode(Path(folder) / "pick/episodes/episode_000001")
        images = [Image.frombytes("RGB", SIZE, bytes(item.message.data)) for item in reader.messages({TOPIC})][::KEPT]
        reader.close()
    out = Path(__file__).with_name("pick.webp")
    period_ms = 1000 * KEPT // 30
    images[0].save(out, save_all=True, append_images=images[1:], duration=period_ms, loop=0, quality=60, method=6)
    print(f"{out}: {len(images)} images, {out.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()

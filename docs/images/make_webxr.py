"""Make `webxr_phone.webp`, the page on a phone: `uv run --with pillow python docs/images/make_webxr.py`.

Launches the simulated SO-101 with its cameras, and opens the page in Chromium as on a phone.
"""

from __future__ import annotations

import io
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

from PIL import Image
from playwright.sync_api import sync_playwright

PHONE: dict[str, Any] = {
    "viewport": {"width": 390, "height": 760},
    "device_scale_factor": 1.5,
    "has_touch": True,
    "is_mobile": True,
}
SETTINGS = {
    "teleoperation.phone": {"type": "webxr", "port": 0},
    "control_modes.phone": {"executors": ["arm_position", "gripper_position"], "teleop": "phone"},
}


def main() -> None:
    """Launch the robot, open the page, and write the picture."""
    overrides = [word for key, value in SETTINGS.items() for word in ("--set", f"{key}={json.dumps(value)}")]
    command = [Path(sys.executable).with_name("ibrobot"), "launch", "so101", "--sim", "--mode", "phone", *overrides]
    launch = subprocess.Popen([*command, "--headless", "--duration", "60"], stderr=subprocess.PIPE, text=True)
    assert launch.stderr is not None
    address = next(found[0] for line in launch.stderr if (found := re.search(r"https://\S+token=\S+", line)))
    with sync_playwright() as playwright:
        args = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=args)
        page = browser.new_context(ignore_https_errors=True, **PHONE).new_page()
        page.goto(address)
        page.get_by_role("button", name="Use this phone").click()
        page.locator("figure img").nth(1).wait_for()
        page.locator("#link", has_text="Hz").wait_for()
        page.wait_for_timeout(2000)
        picture = Image.open(io.BytesIO(page.screenshot()))
        browser.close()
    launch.terminate()
    launch.communicate()
    picture.save(Path(__file__).parent / "webxr_phone.webp", quality=85)


if __name__ == "__main__":
    main()

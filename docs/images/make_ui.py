"""Screenshots of `ibrobot ui` for the documentation, taken on the way that the tests walk; needs Chromium.

    uv run --with pillow python docs/images/make_ui.py

Writes ui_*.webp here. `plugins/ibrobot-plugin-web/tests/look.py` takes pictures of all views in all states to look at.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from io import BytesIO
from pathlib import Path
from typing import Any

from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[2] / "tests/shared"))

_WIDTH, _HEIGHT = 1440, 900
"""Size of the page in the documentation [px]."""
_MOST = 1300
"""Largest height of a picture [px]."""


def main() -> None:
    """Take the screenshots."""
    from playwright.sync_api import sync_playwright
    from ui_path import FLAGS, convert, own_robot, record, ui_process

    here = Path(__file__).parent

    def shot(page: Any, name: str) -> None:
        page.evaluate("window.scrollTo(0, 0)")
        for _ in range(100):
            shown = page.locator("main").inner_text()
            waits = any(each in shown for each in ("Loading", "Drawing the robot", "The server makes"))
            if not waits and not page.locator(".toast").count():
                break
            page.wait_for_timeout(200)
        page.wait_for_timeout(1500)
        path = here / f"ui_{name}.webp"
        whole = page.locator("#nav").count() > 0  # the page of a run fits its window
        image = Image.open(BytesIO(page.screenshot(full_page=whole)))
        image.crop((0, 0, image.width, min(image.height, _MOST))).save(path, quality=85)
        print(path)

    with tempfile.TemporaryDirectory() as made, sync_playwright() as playwright:
        folder = Path(made) / "arm"
        folder.mkdir()
        own_robot(folder, "width: 320, height: 240, fps: 30")
        own = folder / "my_arm.yaml"  # a picture takes long where software draws
        own.write_text(own.read_text(encoding="utf-8").replace("max_duration_s: 20", "max_duration_s: 90"), "utf-8")
        with ui_process(folder) as address:
            chromium = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
            page = chromium.new_context(viewport={"width": _WIDTH, "height": _HEIGHT}).new_page()
            page.goto(address)
            record(page, shot)
            convert(page, shot)
            page.get_by_role("link", name="Devices").click()
            shot(page, "devices")
            chromium.close()


if __name__ == "__main__":
    main()

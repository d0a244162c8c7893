"""Screenshots of the page for the documentation; needs Chromium.

    uv run --with pillow python docs/images/make_page.py

Writes page.webp and page_phone.webp here. `plugins/ibrobot-plugin-web/tests/look.py` takes pictures of all states to
look at.
"""

from __future__ import annotations

import shutil
import sys
from io import BytesIO
from pathlib import Path
from typing import Any

from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[2] / "tests/shared"))

FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=gl-egl", "--ignore-gpu-blocklist"]
DESKTOP, PHONE = (1440, 900), (390, 844)


def opened(chromium: Any, address: str, size: tuple[int, int], theme: str) -> Any:
    """The page, once it shows the robot."""
    context = chromium.new_context(viewport={"width": size[0], "height": size[1]}, color_scheme=theme)
    page = context.new_page()
    page.goto(address)
    while page.evaluate("ibrobot.view.frames") < 5:
        page.wait_for_timeout(100)
    page.wait_for_timeout(1500)
    return page


def save(page: Any, path: Path) -> None:
    """Write the page as WebP."""
    Image.open(BytesIO(page.screenshot())).save(path, quality=85)
    print(path)


def main() -> None:
    """Take the screenshots."""
    from page_run import page_run
    from playwright.sync_api import sync_playwright

    here = Path(__file__).parent
    with page_run("so101", "--sim") as address, sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
        save(opened(chromium, address, DESKTOP, "light"), here / "page.webp")
        page = opened(chromium, address, PHONE, "dark")
        page.get_by_role("button", name="Take over").click()
        page.locator("#mode summary").click()
        page.get_by_role("button", name="drive from the page").click()
        page.wait_for_timeout(2000)
        page.evaluate("window.scrollTo(0, 0)")
        page.wait_for_timeout(500)
        save(page, here / "page_phone.webp")


if __name__ == "__main__":
    main()

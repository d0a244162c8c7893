"""Screenshots of evaluations and blinded trials on the page of `ibrobot ui`, for the documentation; needs Chromium.

    uv run --with pillow python docs/images/make_evaluations.py

Writes ui_evaluation.webp, ui_failures.webp and ui_trial.webp here. It evaluates two policies first, which takes some
minutes. The camera of the trials is a film of that evaluation.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from io import BytesIO
from pathlib import Path
from typing import Any

from PIL import Image

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "tests/shared"))
_MODELS = "  quick: {type: scripted_pick, speed: 1.0}\n"
_EXECUTORS = "executors: [arm_position, gripper_position]"
_MODES = "".join(
    f"  {mode}: {{{_EXECUTORS}, inference: {{model: {model}}}}}\n"
    for mode, model in (("careful", "scripted_pick"), ("hasty", "quick"))
)
_CAMERA = "peripherals:\n  - {name: top, kind: camera, type: opencv, device: camera.mp4, loop: true}\n"
_SIZE = {"width": 1200, "height": 800}


def evaluate(folder: Path) -> None:
    """Evaluate two policies, into the folder `night`, unless it is there."""
    from page_run import IBROBOT

    text = (ROOT / "configs/so101_pick_cube.yaml").read_text(encoding="utf-8")
    text = text.replace("max_duration_s: 20", "max_duration_s: 4.9")  # so that some episodes fail
    text = text.replace("\nmodels:\n", f"\nmodels:\n{_MODELS}").replace(
        "\ncontrol_modes:\n", f"\ncontrol_modes:\n{_MODES}"
    )
    (folder / "my_so101.yaml").write_text(text, encoding="utf-8")
    words = ["--mode", "careful", "--mode", "hasty", "--episodes", "12", "--vary", "simulation.latency=0:0.24:4"]
    subprocess.run([*IBROBOT, "eval", "my_so101.yaml", "--sim", *words, "--out", "night"], cwd=folder, check=True)


def shot(page: Any, name: str) -> None:
    """Take a screenshot."""
    page.wait_for_timeout(1500)
    path = Path(__file__).parent / f"ui_{name}.webp"
    Image.open(BytesIO(page.screenshot())).save(path, quality=80)
    print(path)


def main() -> None:
    """Take the screenshots."""
    from blinded_arm import ARM, NAMES
    from ibrobot_testing.site import Site
    from playwright.sync_api import sync_playwright
    from ui_path import FLAGS, ui_process

    with tempfile.TemporaryDirectory() as made, sync_playwright() as playwright:
        folder, plugins = Path(made) / "arm", Path(made) / "plugins"
        folder.mkdir()
        plugins.mkdir()
        os.environ["PYTHONPATH"] = str(plugins)
        Site(plugins, ROOT / "tests/shared/plugins").add("ibrobot-reaching", "reaching_arm.py")
        evaluate(folder)
        films = sorted((folder / "night/videos").glob("*/*.mp4"))
        (folder / "trial.yaml").write_text(ARM + _CAMERA, encoding="utf-8")
        shutil.copyfile(films[0], folder / "camera.mp4")
        with ui_process(folder) as address:
            chromium = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
            page = chromium.new_context(viewport=_SIZE).new_page()
            page.goto(address)
            page.get_by_role("link", name="Results").click()
            page.get_by_role("link", name="night").click()
            page.get_by_role("heading", name="Failures").wait_for()
            shot(page, "evaluation")
            page.get_by_role("heading", name="Failures").scroll_into_view_if_needed()
            page.get_by_role("heading", name="Failures").evaluate("(head) => head.scrollIntoView()")
            page.mouse.wheel(0, -80)
            shot(page, "failures")
            page.get_by_role("link", name="Evaluate", exact=True).click()
            page.get_by_label("trial.yaml").check()
            page.get_by_label("Modes").fill(", ".join(NAMES))
            page.get_by_label("Episodes", exact=True).fill("20")
            page.get_by_label("Folder").fill("trials")
            page.get_by_role("button", name="Evaluate", exact=True).click()
            page.get_by_role("button", name="Begin the trial").click(timeout=90_000)
            page.get_by_role("button", name="Success").click(timeout=90_000)
            shutil.copyfile(films[-1], folder / "camera.mp4")
            page.get_by_text("as in the picture").wait_for(timeout=90_000)
            page.locator(".job").evaluate("(card) => card.scrollIntoView()")
            page.mouse.wheel(0, -80)
            shot(page, "trial")
            chromium.close()


if __name__ == "__main__":
    main()

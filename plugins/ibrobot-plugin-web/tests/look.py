"""Every view and dialog of both pages, in all states: pictures to look at, and what axe-core finds.

    npm pack axe-core && tar xzf axe-core-*.tgz
    uv run python plugins/ibrobot-plugin-web/tests/look.py FOLDER --axe package/axe.min.js [--only run]
    uv run python plugins/ibrobot-plugin-web/tests/look.py FOLDER --axe package/axe.min.js --only empty --language zh-CN

Writes FOLDER/STATE-SIZE-THEME.png for three sizes and for a desktop at 200 %, light and dark. Prints what axe-core
finds serious or critical, and exits with 1 if there is any. It needs Chromium and playwright, takes ten minutes, and
looks at training where LeRobot is installed.
"""

from __future__ import annotations

import argparse
import contextlib
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[3] / "tests/shared"))

FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=gl-egl", "--ignore-gpu-blocklist"]
SIZES = {
    "phone": (390, 844),
    "zoom": (720, 450),
    "tablet": (1024, 768),
    "wide": (1920, 1080),
    "desktop": (1440, 900),
}
"""Width and height [px]; 1440x900 at 200 % has the layout of half its size. The last one stays set."""
CHECKED = ("phone", "desktop")
"""Sizes at which axe checks: the layouts differ in these."""
LANGUAGE = ["en"]
"""Language of the browser; the parts that press buttons know them in English."""
LOADS = "(each) => each.checkVisibility() && each.textContent.endsWith('…')"
PANELS = ("Plots", "Health", "Log")
_SETTLE_MS = 400
WRONG = """robot:
  name: wrong
  joints:
    - {name: pan, lower: 1.0, upper: -1.0, max_velocty: 3.0, max_acceleration: 20.0}
hardware: {type: feetech_so100, port: /dev/ttyACM0}
"""
POLICY = ("    inference: {model: scripted_pick}", "    inference: {model: scripted_pick, intervene: web}")
"""What lets an operator take the robot from the policy by the page."""


class Look:
    """Takes pictures of a state in all sizes and themes, and checks it.

    Args:
        folder: for the pictures.
        axe: source of axe-core; empty to check nothing.
    """

    def __init__(self, folder: Path, axe: str) -> None:
        self._folder = folder
        self._axe = axe
        self.wrong = 0
        folder.mkdir(parents=True, exist_ok=True)

    def __call__(self, page: Any, name: str) -> None:
        """Look at the state of a page."""
        page.evaluate("window.scrollTo(0, 0)")
        for theme in ("light", "dark"):
            page.emulate_media(color_scheme=theme)
            for size, (width, height) in SIZES.items():
                page.set_viewport_size({"width": width, "height": height})
                page.wait_for_timeout(_SETTLE_MS)
                page.screenshot(path=self._folder / f"{name}-{size}-{theme}.png", full_page=True)
                if self._axe and size in CHECKED:
                    self._check(page, f"{name}, {size}, {theme}")
        print(name, flush=True)

    def _check(self, page: Any, where: str) -> None:
        if page.evaluate("typeof axe === 'undefined'"):
            page.add_script_tag(content=self._axe)
        for each in page.evaluate("axe.run(document, {resultTypes: ['violations']})")["violations"]:
            if each["impact"] not in ("serious", "critical"):
                continue
            self.wrong += 1
            targets = ", ".join(str(node["target"][0]) for node in each["nodes"][:4])
            print(f"{where}: {each['impact']}: {each['id']}: {each['help']}: {targets}", flush=True)


def opened(chromium: Any, address: str) -> Any:
    """A page in a browser of its own."""
    width, height = SIZES["desktop"]
    viewport = {"width": width, "height": height}
    page = chromium.new_context(viewport=viewport, bypass_csp=True, locale=LANGUAGE[0]).new_page()
    page.goto(address)
    return page


def view(page: Any, name: str) -> None:
    """Go to a view, and wait until it shows what it loads."""
    page.evaluate(f"location.hash = {name!r}")
    page.wait_for_timeout(2500)
    loaded(page)


def loaded(page: Any) -> None:
    """Wait until no note says any more that something loads: `Reading …`, `Opening …`."""
    from ui_path import until

    until(page, f"![...document.querySelectorAll('.note')].some({LOADS})")


def look_at_empty(chromium: Any, look: Look) -> None:
    """`ibrobot ui` in an empty folder, without its link, and after its end."""
    from ui_path import ui_process, until

    with tempfile.TemporaryDirectory() as made, ui_process(Path(made)) as address:
        page = opened(chromium, address)
        until(page, "ibrobot.session.views.length")
        for name in page.evaluate("ibrobot.session.views.map(({name}) => name)"):
            view(page, name)
            look(page, f"ui-empty-{name}")
        look(opened(chromium, address.split("?")[0]), "no-link")
    page.wait_for_timeout(2000)
    view(page, "record")
    look(page, "ui-ended")


def look_at_filled(chromium: Any, look: Look) -> None:
    """`ibrobot ui` on the way from a robot to its dataset, and what goes wrong on it."""
    from ui_path import convert, own_robot, record, ui_process

    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        own_robot(folder)
        own = folder / "my_arm.yaml"  # looking at an episode takes longer than 20 s
        own.write_text(own.read_text(encoding="utf-8").replace("max_duration_s: 20", "max_duration_s: 900"), "utf-8")
        (folder / "wrong.yaml").write_text(WRONG, encoding="utf-8")
        (folder / "training/checkpoints/last/pretrained_model").mkdir(parents=True)
        (folder / "training/checkpoints/last/pretrained_model/config.json").write_text("{}", encoding="utf-8")
        with ui_process(folder) as address:
            page = opened(chromium, address)
            record(page, lambda page, name: look(page, f"ui-{name}"))
            convert(page, lambda page, name: look(page, f"ui-{name}"))
            look_at_episodes(page, look, folder)
            look_at_failures(page, look)
            look_at_devices(page, look)
            view(page, "policies")
            page.get_by_role("button", name="Show the change").click()
            page.wait_for_timeout(2000)
            look(page, "ui-policies-change")
            view(page, "jobs")
            page.locator(".job summary:visible").first.click()
            look(page, "ui-jobs")


def look_at_episodes(page: Any, look: Look, folder: Path) -> None:
    """Episodes that are chosen, trimmed, deleted and damaged."""
    view(page, "episodes")
    page.get_by_label("Choose all").check()
    look(page, "ui-episodes-chosen")
    page.get_by_role("link", name="episode_000001").click()
    page.get_by_role("button", name="Begin here").wait_for()
    page.get_by_label("Time", exact=True).fill("0.5")
    page.get_by_role("button", name="Begin here").click()
    page.get_by_role("button", name="Trim to this span").click()
    look(page, "ui-dialog-trim")
    page.get_by_role("button", name="Trim", exact=True).click()
    page.wait_for_timeout(4000)
    damaged = next((folder / "episodes/pick/episodes/episode_000002").glob("*.mcap"))
    damaged.write_bytes(damaged.read_bytes()[:2000])
    view(page, "episodes")
    page.get_by_text("Trash: ").click()
    look(page, "ui-episodes-trash")
    page.get_by_role("button", name="Empty the trash").click()
    look(page, "ui-dialog-empty")
    page.get_by_role("button", name="Cancel").click()
    page.get_by_role("link", name="episode_000002").click()
    page.wait_for_timeout(2000)
    look(page, "ui-episode-damaged")


def look_at_failures(page: Any, look: Look) -> None:
    """A YAML with problems, a run and a conversion that fail, and an error."""
    view(page, "robots")
    page.get_by_label("Robot", exact=True).select_option("wrong.yaml")
    page.wait_for_timeout(1500)
    look(page, "ui-robots-problems")
    page.get_by_label("Robot", exact=True).select_option("my_arm.yaml")
    page.get_by_label("Real hardware").check()
    page.get_by_text("No problems found.").wait_for()
    look(page, "ui-robots-hardware")
    page.get_by_role("button", name="Launch").click()
    page.locator(".job .state.failed").first.wait_for(timeout=60_000)
    look(page, "ui-robots-failed")
    page.get_by_label("Simulation").check()
    view(page, "job-convert")
    page.get_by_label("Dataset", exact=True).fill("datasets/pick")
    page.get_by_label("Add to it").check()
    page.get_by_text("More options").click()
    page.get_by_label("Unit of joints").select_option("degrees")
    page.get_by_role("button", name="Convert", exact=True).click()
    page.locator(".job .state.failed:visible").first.wait_for(timeout=60_000)
    look(page, "ui-convert-failed")
    page.evaluate("void ibrobot.attempt(() => ibrobot.get('episodes/open', {path: '../elsewhere'}))")
    page.wait_for_timeout(500)
    look(page, "ui-toast")


def look_at_devices(page: Any, look: Look) -> None:
    """The guides of devices: one that works, one that asks, and one that fails."""
    view(page, "devices")
    guides = page.locator(".guides form button")
    for number in range(guides.count()):
        guides.nth(number).click()
        page.locator(".card .state.done, .card .state.failed, .ask:not(:empty)").first.wait_for(timeout=60_000)
        page.wait_for_timeout(1500)
        look(page, f"ui-devices-{number}")
        if page.locator(".ask:not(:empty)").count():
            page.get_by_role("button", name="Cancel").click()
            page.locator(".card .state.done, .card .state.failed").first.wait_for(timeout=60_000)


def look_at_run(chromium: Any, look: Look) -> None:
    """The page of a run: all tabs, an operator, watchers, faults, dialogs, plans, and after its end."""
    from page_run import page_run

    with page_run("so101", "--sim", "--mode", "web") as address:
        page = ready(chromium, address)
        look(page, "run-drive")
        for panel in PANELS:
            page.get_by_role("button", name=panel, exact=True).click()
            page.wait_for_timeout(2500)
            look(page, f"run-{panel.lower()}")
        page.get_by_role("button", name="Log", exact=True).click()
        page.keyboard.press("2")
        look(page, "run-camera")
        page.keyboard.press("1")
        page.locator("#mode summary").click()
        look(page, "run-modes")
        page.locator("#mode summary").click()
        page.get_by_role("button", name="End the run").click()
        look(page, "run-dialog-end")
        page.get_by_role("button", name="Keep it running").click()
        other = ready(chromium, address)
        look(other, "run-watcher")
        other.close()
        link = page.evaluate("location.origin + ibrobot.links.watch")
        watcher = ready(chromium, link)
        look(watcher, "run-watch-link")
        watcher.close()
        page.locator("#mode summary").click()
        page.get_by_role("button", name="plan motions").click()
        page.locator("#goal").wait_for()
        page.get_by_role("button", name="rest", exact=True).click()
        page.get_by_text("The path takes").wait_for()
        look(page, "run-preview")
        page.locator("#goal").fill("xyz=3,0,0")
        page.get_by_role("button", name="Preview").click()
        page.get_by_text("No path").wait_for()
        look(page, "run-no-path")
        page.keyboard.press("Escape")
        page.locator("#faults .fault").first.wait_for()
        look(page, "run-fault")
        page.locator("#faults button").first.click()
        page.wait_for_timeout(500)
    page.wait_for_timeout(3000)
    look(page, "run-ended")


def look_at_policy(chromium: Any, look: Look) -> None:
    """The page of a run whose policy an operator corrects, without cameras, and then of seven joints."""
    from page_run import page_run
    from seven_joints import write_seven_joints

    with tempfile.TemporaryDirectory() as made:
        config = Path(made) / "corrected.yaml"
        content = (Path(__file__).parents[3] / "configs/so101_pick_cube.yaml").read_text(encoding="utf-8")
        assert POLICY[0] in content
        config.write_text(content.replace(*POLICY) + "\nepisodes: {takeover: deadman}\n", "utf-8")
        with page_run(str(config), "--sim", "--episodes", "50") as address:
            page = ready(chromium, address)
            page.wait_for_timeout(3000)
            look(page, "run-policy")
            page.get_by_role("button", name="Take the robot").click()
            page.wait_for_timeout(1500)
            look(page, "run-policy-taken")
        with page_run(str(write_seven_joints(Path(made))), "--sim") as address:
            look(ready(chromium, address), "run-seven-joints")


def look_at_training(chromium: Any, look: Look) -> None:
    """Training, its end, and a run of the trained policy; needs LeRobot in this environment."""
    from page_run import IBROBOT
    from ui_path import ROOT, ui_process

    with tempfile.TemporaryDirectory() as made:
        config = shutil.copy(ROOT / "configs/so101_pick_cube.yaml", Path(made) / "picking.yaml")
        run = ("record", config, "--sim", "--lockstep", "--dataset", "pick", "--episodes", "2", "--headless")
        for command in (run, ("convert", "episodes", "--out", "datasets/pick")):
            subprocess.run([*IBROBOT, *command], cwd=made, check=True, stdin=subprocess.DEVNULL)
        with ui_process(Path(made)) as address:
            page = opened(chromium, address)
            view(page, "job-train")
            page.get_by_label("Steps", exact=True).fill("200")
            page.get_by_label("Frames per step").fill("8")
            page.get_by_label("Folder").fill("training")
            page.get_by_role("button", name="Train").click()
            page.get_by_text("step 1", exact=False).first.wait_for(timeout=180_000)
            look(page, "ui-training-running")
            page.get_by_role("link", name="Use it in a robot").click(timeout=300_000)
            page.locator("#use-robot").select_option("picking.yaml")
            look(page, "ui-training-done")
            page.get_by_role("button", name="Show the change").click()
            page.get_by_role("button", name="Write the file picking.yaml").click()
            with page.context.expect_page(timeout=120_000) as opening:
                page.get_by_role("button", name="Launch it in simulation").click()
            run_page = opening.value
            run_page.wait_for_url(lambda url: url.startswith("http"), wait_until="commit", timeout=120_000)
            for _ in range(1200):
                if run_page.evaluate("(window.ibrobot?.status?.counts.dispatch?.plan_length ?? 0) > 0"):
                    break
                run_page.wait_for_timeout(100)
            print("runs", run_page.evaluate("[ibrobot.status.mode, ibrobot.status.counts.dispatch]"), flush=True)
            run_page.get_by_role("button", name="Plots", exact=True).click()
            run_page.wait_for_timeout(3000)
            run_page.locator("#plot-topic").select_option("counters of dispatch")
            look(run_page, "run-trained")


def ready(chromium: Any, address: str) -> Any:
    """The page of a run, once it shows the robot."""
    page = opened(chromium, address)
    page.wait_for_timeout(500)
    for _ in range(300):
        if page.evaluate("Boolean(ibrobot?.status) && ibrobot.view.frames > 3"):
            break
        page.wait_for_timeout(100)
    page.wait_for_timeout(1000)
    return page


PARTS = {
    "empty": look_at_empty,
    "filled": look_at_filled,
    "run": look_at_run,
    "policy": look_at_policy,
    "training": look_at_training,
}


@contextlib.contextmanager
def browser() -> Iterator[Any]:
    """Chromium."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
        yield chromium
        chromium.close()


def main() -> None:
    """Look at everything."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, help="for the pictures")
    parser.add_argument("--axe", type=Path, help="axe.min.js; without it nothing is checked")
    parser.add_argument("--only", choices=PARTS, action="append", help="a part of the pages")
    parser.add_argument("--language", default=LANGUAGE[0], help="of the browser; others than en for --only empty")
    chosen = parser.parse_args()
    LANGUAGE[0] = chosen.language
    look = Look(chosen.folder, chosen.axe.read_text(encoding="utf-8") if chosen.axe is not None else "")
    parts = [name for name in PARTS if name != "training" or find_spec("lerobot") is not None]
    for name in chosen.only or parts:
        with browser() as chromium:
            PARTS[name](chromium, look)
    print(f"{look.wrong} serious or critical")
    sys.exit(1 if look.wrong else 0)


if __name__ == "__main__":
    main()

"""The way from choosing a robot to playing back its dataset, by clicks alone on the page of `ibrobot ui`."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from page_run import IBROBOT

ROOT = Path(__file__).parents[2]
FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=gl-egl", "--ignore-gpu-blocklist"]
SMALL = {"device_scale_factor": 0.25}
"""Of a browser's page: software draws it, so a sixteenth of the pixels, in the same layout."""
_WAIT_MS = 60_000
Shot = Callable[[Any, str], None]
"""Takes a screenshot of a page, by name."""


@contextmanager
def ui_process(folder: Path) -> Iterator[str]:
    """Run `ibrobot ui` in a folder, and yield the address of its page."""
    with tempfile.TemporaryFile("w+", encoding="utf-8") as log:
        served = subprocess.Popen(
            [*IBROBOT, "ui", "--port", "0", "--no-browser"],
            cwd=folder,
            stdout=log,
            stderr=log,
            stdin=subprocess.DEVNULL,
            start_new_session=True,
            env={**os.environ, "CI": "1"},
        )
        try:
            deadline_s = time.monotonic() + 60
            found = None
            while found is None and time.monotonic() < deadline_s and served.poll() is None:
                time.sleep(0.05)
                log.seek(0)
                found = re.search(r"page: (\S+)", log.read())
            assert found is not None, "the page did not come up"
            yield found[1]
        finally:
            served.send_signal(signal.SIGINT)
            try:
                served.wait(30)
            finally:
                served.kill()
                served.wait()


def own_robot(folder: Path, size: str = "width: 160, height: 120, fps: 10") -> None:
    """Put a robot YAML with small pictures into a folder, as its owner would."""
    content = (ROOT / "configs/so101.yaml").read_text(encoding="utf-8")
    content = content.replace("width: 640, height: 480, fps: 30", size)
    (folder / "my_arm.yaml").write_text(content, encoding="utf-8")


def until(page: Any, expression: str) -> None:
    """Wait until an expression is true; the page's policy forbids Playwright's own way, which needs `eval`."""
    deadline_s = time.monotonic() + _WAIT_MS / 1000
    while not page.evaluate(f"Boolean({expression})"):
        assert time.monotonic() < deadline_s, f"still not: {expression}"
        page.wait_for_timeout(50)


def reach(page: Any, element: Any) -> None:
    """Go to an element by the tab key."""
    element.wait_for()
    for _ in range(120):
        if element.evaluate("each => each === document.activeElement"):
            assert element.evaluate("each => each.matches(':focus-visible')"), "the focus is visible"
            return
        page.keyboard.press("Tab")
    raise AssertionError(f"{element}: not reached by the tab key")


def press(page: Any, label: str, expression: str) -> None:
    """Hold a button until an expression is true; press again as a person does, since a page that stalls releases it."""
    page.get_by_label(label).hover()
    deadline_s = time.monotonic() + _WAIT_MS / 1000
    while True:
        page.mouse.down()
        for _ in range(60):
            if page.evaluate(f"Boolean({expression})"):
                return
            page.wait_for_timeout(50)
        assert time.monotonic() < deadline_s, f"still not: {expression}"
        page.mouse.up()


def record(page: Any, shot: Shot = lambda page, name: None) -> None:
    """Choose the robot, launch a session that records it, jog, and record and judge two episodes.

    The second one begins and is judged by keys.
    """
    page.context.set_default_timeout(_WAIT_MS)  # Playwright's 30 s are too short for software that draws beside a run
    page.get_by_role("link", name="Robots").click()
    page.get_by_label("Robot", exact=True).select_option("my_arm.yaml")
    page.get_by_label("Simulation").check()
    page.get_by_text("No problems found.").wait_for(timeout=_WAIT_MS)
    shot(page, "robots")
    page.get_by_role("link", name="Record episodes").click()
    page.get_by_label("Task").fill("pick the cube")
    page.get_by_label("Dataset").fill("pick")
    page.get_by_label("Episodes", exact=True).fill("2")
    page.get_by_label("Dataset").blur()
    shot(page, "record")
    with page.context.expect_page(timeout=_WAIT_MS) as opened:
        page.get_by_role("button", name="Start the session").click()
    run = opened.value  # it shows the robot's page once the robot has started
    run.wait_for_url(re.compile("^http"), wait_until="commit", timeout=2 * _WAIT_MS)
    until(run, "window.ibrobot?.jogs.length && ibrobot.status.episode")
    # Joints that meet nothing, however long a busy machine takes to release the button.
    for number, (joint, index, verdict) in enumerate([("shoulder_pan", 0, "Success"), ("wrist_roll", 4, "Failure")]):
        if number == 0:
            run.get_by_role("button", name="Begin").click()
        else:
            until(run, "ibrobot.status.episode.recording === false")
            run.keyboard.press("b")
        before = run.evaluate("ibrobot.state.position")
        moved = f"Math.abs(ibrobot.state.position[{index}] - {before[index]}) > 0.3"
        moved = f"ibrobot.status.episode.elapsed_s > 1 && {moved}"
        press(run, f"{joint} up, hold to move", moved)
        if number == 0:
            shot(run, "episode")
        run.mouse.up()
        if number == 0:
            run.get_by_role("button", name=verdict).click()
            until(run, "ibrobot.status.episode.saved === 1")
        else:
            run.get_by_role("button", name=verdict).wait_for()
            run.keyboard.press(verdict[0].lower())
    page.locator(".job .state:not(.running)").first.wait_for(timeout=_WAIT_MS)
    assert page.locator(".job .state.done").count() == 1, page.locator(".job").all_inner_texts()
    until(run, "ibrobot.status.ended")
    assert "2 of 2 saved" in run.locator("#faults .ended").inner_text()
    until(run, "ibrobot.connected === false")
    assert run.locator("#faults .fault, #connection.bad").count() == 0, "an end is no alarm"
    assert run.locator("#stop").is_disabled()
    shot(run, "ended")
    assert run.get_by_role("link", name="Judge and convert").get_attribute("href").startswith(page.url.split("#")[0])
    run.close()
    shot(page, "session")


def convert(page: Any, shot: Shot = lambda page, name: None) -> None:
    """Play back an episode, convert the successes, and play back the dataset."""
    page.get_by_role("link", name="Judge the episodes").click()
    page.get_by_role("link", name="episode_000001").click(timeout=_WAIT_MS)
    plays(page)
    shot(page, "episodes")
    page.get_by_role("link", name="Record", exact=True).click()
    page.locator(".job").get_by_role("link", name="Convert", exact=True).click()
    until(page, "document.querySelector('#field-out')?.value === 'datasets/pick'")  # filled in
    page.get_by_role("button", name="Convert", exact=True).click()
    page.get_by_role("link", name="Open the dataset").wait_for(timeout=_WAIT_MS)
    shot(page, "convert")
    page.get_by_role("link", name="Open the dataset").click()
    page.get_by_role("button", name="Play 0").click(timeout=_WAIT_MS)
    plays(page)
    shot(page, "datasets")


def plays(page: Any) -> None:
    """Wait until the player on the page plays."""
    time_line = page.get_by_label("Time", exact=True)
    time_line.wait_for(timeout=_WAIT_MS)
    page.locator("output.clock:visible").filter(has_text=" of ").wait_for(timeout=_WAIT_MS)
    play = page.get_by_role("button", name="Play", exact=True)
    if play.count():  # a dataset's episode plays at once
        play.click()
    deadline_s = time.monotonic() + _WAIT_MS / 1000
    while float(time_line.input_value()) < 0.3:
        assert time.monotonic() < deadline_s, "the player does not play"
        page.wait_for_timeout(50)

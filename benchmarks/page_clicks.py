"""Clicks, keys and typed characters from an empty folder to a trained policy that runs, on the page of `ibrobot ui`.

    python benchmarks/page_clicks.py [--episodes 10] [--steps 50] [--no-training]

Needs Chromium and playwright, and LeRobot to train. Walks the way with the fewest inputs, with the simulated SO-101
without cameras: records and judges episodes, converts them, trains, and launches the result. A choice from a list
counts as two clicks, a button that is held as one. Prints a table.
"""

from __future__ import annotations

import argparse
import re
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "tests/shared"))

from ui_path import FLAGS, ui_process, until

ROBOT = "so101_pick_cube"
TASK = "pick the cube"
_WAIT_MS = 120_000
_TRAIN_MS = 600_000


class Hand:
    """The mouse and the keyboard of a person, counted by stage."""

    def __init__(self) -> None:
        self.stages: dict[str, list[float]] = {}
        self._began_s = time.monotonic()
        self._counts = [0.0, 0.0, 0.0, 0.0]

    def stage(self, name: str) -> None:
        """Begin a stage."""
        self._end()
        self._counts = self.stages[name] = [0.0, 0.0, 0.0, 0.0]

    def _end(self) -> None:
        now_s = time.monotonic()
        self._counts[3] += now_s - self._began_s
        self._began_s = now_s

    def click(self, target: Any, **options: Any) -> None:
        """Click something."""
        target.click(**options)
        self._counts[0] += 1

    def choose(self, target: Any, value: str) -> None:
        """Choose from a list: one click opens it, one chooses."""
        target.select_option(value)
        self._counts[0] += 2

    def key(self, page: Any, key: str) -> None:
        """Press a key."""
        page.keyboard.press(key)
        self._counts[1] += 1

    def fill(self, target: Any, text: str) -> None:
        """Click into a field, and type in place of what it has."""
        target.fill(text)
        self._counts[0] += 1
        self._counts[2] += len(text)

    def hold(self, page: Any, button: Any, expression: str) -> None:
        """Hold a button until something is true; again, as a person does, if a stall of the page released it."""
        deadline_s = time.monotonic() + _WAIT_MS / 1000
        button.hover()
        while True:
            page.mouse.down()
            self._counts[0] += 1
            for _ in range(60):
                if page.evaluate(f"Boolean({expression})"):
                    page.mouse.up()
                    return
                page.wait_for_timeout(50)
            page.mouse.up()
            assert time.monotonic() < deadline_s, f"still not: {expression}"

    def table(self) -> None:
        """Print what was counted."""
        self._end()
        print(f"{'stage':<32}{'clicks':>8}{'keys':>8}{'characters':>12}{'seconds':>10}")
        total = [sum(column) for column in zip(*self.stages.values(), strict=True)]
        for name, (clicks, keys, characters, seconds) in [*self.stages.items(), ("all", total)]:
            print(f"{name:<32}{clicks:>8.0f}{keys:>8.0f}{characters:>12.0f}{seconds:>10.0f}")


def record(hand: Hand, page: Any, episodes: int) -> None:
    """Choose the robot, record the episodes, and judge each as it ends."""
    hand.stage("choose the robot, begin to record")
    hand.click(page.get_by_role("link", name="Record", exact=True))
    hand.choose(page.get_by_label("Robot", exact=True), ROBOT)
    page.get_by_text("No problems found.").wait_for(timeout=_WAIT_MS)
    hand.fill(page.get_by_label("Task"), TASK)
    hand.fill(page.get_by_label("Episodes", exact=True), str(episodes))
    with page.context.expect_page(timeout=_WAIT_MS) as opened:
        hand.click(page.get_by_role("button", name="Start the session"))
    run = opened.value
    run.wait_for_url(re.compile("^http"), wait_until="commit", timeout=_WAIT_MS)
    until(run, "window.ibrobot?.jogs.length && ibrobot.status.episode")
    hand.stage(f"record and judge {episodes} episodes")
    for number in range(episodes):
        hand.key(run, "b")
        until(run, "ibrobot.status.episode.waiting")
        move(hand, run, number)
        hand.key(run, "s" if number % 3 else "f")
        until(run, f"ibrobot.status.ended || ibrobot.status.episode.saved === {number + 1}")
    until(run, "ibrobot.status.ended")
    words = run.locator("#faults .ended").inner_text()
    assert f"{episodes} of {episodes} saved" in words, words
    run.close()


def move(hand: Hand, run: Any, number: int) -> None:
    """Move a joint, to the other side each time."""
    button = run.get_by_label(f"wrist_roll {('up', 'down')[number % 2]}, hold to move")
    before = run.evaluate("ibrobot.state.position")[4]
    moved = f"Math.abs(ibrobot.state.position[4] - {before}) > 0.1"
    hand.hold(run, button, f"ibrobot.status.episode.elapsed_s > 1 && {moved}")


def convert(hand: Hand, page: Any) -> None:
    """Convert the episodes to a dataset."""
    hand.stage("convert")
    hand.click(page.locator(".job").get_by_role("link", name="Convert", exact=True), timeout=_WAIT_MS)
    until(page, "document.querySelector('#field-out')?.value.startsWith('datasets/')")
    hand.click(page.get_by_role("button", name="Convert", exact=True))
    page.locator(".job:visible").get_by_role("link", name="Train", exact=True).wait_for(timeout=_WAIT_MS)


def train(hand: Hand, page: Any, steps: int) -> None:
    """Train a policy for a few steps."""
    hand.stage(f"train {steps} steps")
    hand.click(page.locator(".job:visible").get_by_role("link", name="Train", exact=True))
    hand.fill(page.get_by_label("Steps", exact=True), str(steps))
    hand.click(page.get_by_role("button", name="Train", exact=True))
    page.get_by_role("link", name="Use it in a robot").wait_for(timeout=_TRAIN_MS)


def launch(hand: Hand, page: Any) -> None:
    """Put the policy into the robot's YAML, and launch it."""
    hand.stage("launch the policy")
    hand.click(page.get_by_role("link", name="Use it in a robot"))
    hand.click(page.get_by_role("button", name=re.compile("^Write ")))
    with page.context.expect_page(timeout=_WAIT_MS) as opened:
        hand.click(page.get_by_role("button", name="Launch it in simulation"))
    run = opened.value
    run.wait_for_url(re.compile("^http"), wait_until="commit", timeout=_WAIT_MS)
    until(run, "(window.ibrobot?.status?.counts.dispatch?.plan_length ?? 0) > 0")


def main() -> None:
    """Walk the way, and print the table."""
    from playwright.sync_api import sync_playwright

    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--steps", type=int, default=50)
    parser.add_argument("--no-training", action="store_true", help="end after the conversion")
    chosen = parser.parse_args()
    hand = Hand()
    with tempfile.TemporaryDirectory() as folder, ui_process(Path(folder)) as address, sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
        page = chromium.new_context(viewport={"width": 1280, "height": 800}).new_page()
        page.context.set_default_timeout(_WAIT_MS)
        page.goto(address)
        record(hand, page, chosen.episodes)
        convert(hand, page)
        if not chosen.no_training:
            train(hand, page, chosen.steps)
            launch(hand, page)
        hand.table()
        chromium.close()


if __name__ == "__main__":
    main()

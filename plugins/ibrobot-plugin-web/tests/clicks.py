"""The whole way on the page of `ibrobot ui`: from a robot's YAML to a policy that was trained, evaluated and launched.

    npm pack axe-core && tar xzf axe-core-*.tgz
    python plugins/ibrobot-plugin-web/tests/clicks.py FOLDER --axe package/axe.min.js [--keyboard] [--language zh-CN]

Counts the fewest clicks, keys and characters of each stage; with `--keyboard` the pointer is never used, and the tabs
to each place are counted. Writes pictures of each screen, as `look.py` does, and at the end of every view, and prints
what axe-core finds serious or critical. Needs Chromium, playwright and LeRobot.
"""

from __future__ import annotations

import argparse
import importlib
import re
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[3] / "tests/shared"))
from ui_path import ROOT, press, ui_process, until

look: Any = importlib.import_module("look")  # beside this file
_WAIT_MS = 90_000
_LONGEST, _PATIENT = "max_duration_s: 20", "max_duration_s: 120"
_TABS = 150
"""Most tabs to a place."""


class Hand:
    """What a person does with a pointer and a keyboard, counted."""

    def __init__(self) -> None:
        self.clicks = self.keys = self.characters = self.tabs = self.lost = 0

    def press(self, element: Any) -> None:
        """Press a button or follow a link."""
        element.click(timeout=_WAIT_MS)
        self.clicks += 1

    def type(self, element: Any, text: str) -> None:
        """Type into a field, in place of what it contains."""
        element.click()
        self.clicks += 1
        element.fill(text)
        self.characters += len(text)

    def key(self, page: Any, key: str) -> None:
        """Press a key."""
        page.keyboard.press(key)
        self.keys += 1

    def hold(self, page: Any, label: str, expression: str) -> None:
        """Hold a button until an expression is true."""
        press(page, label, expression)
        page.mouse.up()
        self.clicks += 1

    def total(self) -> dict[str, int]:
        """The counts."""
        return {name: value for name, value in vars(self).items() if not name.startswith("_")}


class Keyboard(Hand):
    """A person without a pointer."""

    def __init__(self) -> None:
        super().__init__()
        self._seen = set[Any]()
        """Pages on which something had the focus."""

    def press(self, element: Any) -> None:
        self._reach(element)
        element.page.keyboard.press("Enter")
        self.keys += 1

    def type(self, element: Any, text: str) -> None:
        self._reach(element)
        element.page.keyboard.press("Control+a")
        element.page.keyboard.type(text)
        self.characters += len(text)

    def hold(self, page: Any, label: str, expression: str) -> None:
        self._reach(page.get_by_label(label))
        while not page.evaluate(f"Boolean({expression})"):  # a page that stalls releases it
            page.keyboard.down("Enter")
            page.wait_for_timeout(3000)
            page.keyboard.up("Enter")
        self.keys += 1

    def _reach(self, element: Any) -> None:
        """Go to an element by the tab key."""
        page = element.page
        element.wait_for(timeout=_WAIT_MS)
        if page in self._seen and page.evaluate("document.activeElement === document.body"):
            self.lost += 1
            print(f"before {element}: the focus was lost", flush=True)
        self._seen.add(page)
        for _ in range(_TABS):
            if element.evaluate("each => each === document.activeElement"):
                shown = element.evaluate("each => each.matches(':focus-visible')")
                assert shown, f"{element}: the focus is not visible"
                return
            page.keyboard.press("Tab")
            self.tabs += 1
        raise AssertionError(f"{element}: not reached by {_TABS} tabs")


def said(page: Any, text: str) -> str:
    """A text of the pages in the language of the browser."""
    shown: str = page.evaluate("async (text) => (await import('/static/words.js')).words(text)", text)
    return shown


def button(page: Any, text: str, role: str = "button", within: str = "body") -> Any:
    """The button with a text, or what else has it."""
    return page.locator(within).get_by_role(role, name=said(page, text), exact=True)


def labelled(page: Any, text: str) -> Any:
    """The field with a label."""
    return page.get_by_label(said(page, text), exact=True)


def stages(hand: Hand, page: Any, look_at: Any, episodes: int) -> Iterator[str]:
    """Walk the way; yields the name of each stage that is done."""
    run = begin(hand, page, look_at, episodes)
    yield "choose the robot, begin to record"
    judge(hand, page, run, look_at, episodes)
    yield f"record and judge {episodes} episodes"
    convert(hand, page, look_at)
    yield "convert"
    train(hand, page, look_at)
    yield "train 50 steps"
    launch(hand, page, look_at)
    yield "launch the policy"
    evaluate(hand, page, look_at)
    yield "evaluate the policy"


def begin(hand: Hand, page: Any, look_at: Any, episodes: int) -> Any:
    """Start a session; returns its page."""
    look_at(page, "way-01-first")
    hand.press(button(page, "Record", "link", "#nav"))
    hand.type(labelled(page, "Task"), "pick the cube")
    hand.type(labelled(page, "Episodes"), str(episodes))
    look_at(page, "way-02-record")
    with page.context.expect_page(timeout=_WAIT_MS) as opened:
        hand.press(button(page, "Start the session"))
    run = opened.value
    run.wait_for_url(re.compile("^http"), wait_until="commit", timeout=_WAIT_MS)
    until(run, "window.ibrobot?.jogs.length && ibrobot.status.episode")
    return run


def judge(hand: Hand, page: Any, run: Any, look_at: Any, episodes: int) -> None:
    """Record and judge the episodes."""
    drawn(run)
    look_at(run, "way-03-run")
    for number in range(episodes):
        joint, index = (("shoulder_pan", 0), ("wrist_roll", 4))[number % 2]
        way = ("up", "down")[number // 2 % 2]
        hand.key(run, "b")
        before = run.evaluate("ibrobot.state.position")[index]
        moved = f"ibrobot.status.episode.elapsed_s > 1 && Math.abs(ibrobot.state.position[{index}] - {before}) > 0.2"
        hand.hold(run, said(run, f"{joint} {way}, hold to move"), moved)
        if number == 0:
            look_at(run, "way-04-episode")
        hand.key(run, "s")
        until(run, f"ibrobot.status.episode.saved === {number + 1}")
    look_at(run, "way-05-saved")
    until(run, "ibrobot.status.ended")
    look_at(run, "way-06-ended")
    page.bring_to_front()
    page.locator(".job .state.done").first.wait_for(timeout=_WAIT_MS)


def convert(hand: Hand, page: Any, look_at: Any) -> None:
    """Make a dataset of them."""
    look_at(page, "way-07-session")
    hand.press(button(page, "Convert", "link", ".job"))
    until(page, "document.querySelector('#field-out')?.value")
    look_at(page, "way-08-convert")
    hand.press(button(page, "Convert", within="#main"))
    button(page, "Open the dataset", "link").wait_for(timeout=_WAIT_MS)


def train(hand: Hand, page: Any, look_at: Any) -> None:
    """Train a policy."""
    look_at(page, "way-09-converted")
    hand.press(button(page, "Train", "link", ".job:visible"))
    labelled(page, "Steps").wait_for()
    until(page, "!document.querySelector('#view-job-train form button.primary').disabled")
    hand.type(labelled(page, "Steps"), "50")
    look_at(page, "way-10-train")
    hand.press(button(page, "Train", within="#main"))
    page.locator(".job:visible .state.running").first.wait_for(timeout=_WAIT_MS)
    page.wait_for_timeout(5000)
    look_at(page, "way-11-training")
    button(page, "Use it in a robot", "link").wait_for(timeout=4 * _WAIT_MS)


def launch(hand: Hand, page: Any, look_at: Any) -> None:
    """Put the policy into the robot, and launch it."""
    look_at(page, "way-12-trained")
    hand.press(button(page, "Use it in a robot", "link"))
    write = button(page, "Write the file my_arm.yaml")
    write.wait_for(timeout=_WAIT_MS)
    look_at(page, "way-13-change")
    hand.press(write)
    begins = button(page, "Launch it in simulation")
    begins.wait_for()
    look_at(page, "way-14-written")
    with page.context.expect_page(timeout=_WAIT_MS) as opened:
        hand.press(begins)
    trained = opened.value
    trained.wait_for_url(re.compile("^http"), wait_until="commit", timeout=_WAIT_MS)
    until(trained, "(window.ibrobot?.status?.counts.dispatch?.plan_length ?? 0) > 0")
    drawn(trained)
    look_at(trained, "way-15-runs")
    page.bring_to_front()
    look_at(page, "way-16-running")
    trained.bring_to_front()
    hand.press(button(trained, "End the run", within="#toggles"))
    hand.press(button(trained, "End the run", within="#dialog"))
    until(trained, "ibrobot.status.ended")
    trained.close()
    page.bring_to_front()


def evaluate(hand: Hand, page: Any, look_at: Any) -> None:
    """Count the successes of the policy."""
    hand.press(button(page, "Evaluate it in simulation", "link"))
    button(page, "Evaluate", within="#main").wait_for()
    page.wait_for_timeout(1500)
    look_at(page, "way-17-evaluate")
    hand.type(page.locator("#field-episodes"), "2")
    hand.press(button(page, "Evaluate", within="#main"))
    page.locator(".job:visible .state.done").first.wait_for(timeout=10 * _WAIT_MS)
    look_at(page, "way-18-evaluated")
    hand.press(page.locator(".job:visible").get_by_role("link", name=said(page, "Results")).first)
    page.locator(".report section").first.wait_for(timeout=_WAIT_MS)
    look_at(page, "way-19-results")


def drawn(run: Any) -> None:
    """Wait until the page of a run shows the robot."""
    until(run, "ibrobot.view.frames > 3 && !document.querySelector('#view .note').textContent")


def main() -> None:
    """Walk, count and look."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, help="for the pictures")
    parser.add_argument("--axe", type=Path, help="axe.min.js; without it nothing is checked")
    parser.add_argument("--keyboard", action="store_true", help="without a pointer")
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--language", default=look.LANGUAGE[0], help="of the browser")
    parser.add_argument("--no-pictures", action="store_true", help="only count")
    chosen = parser.parse_args()
    look.LANGUAGE[0] = chosen.language
    for size in ("zoom", "wide"):
        del look.SIZES[size]
    eye = look.Look(chosen.folder, chosen.axe.read_text(encoding="utf-8") if chosen.axe is not None else "")
    look_at = (lambda page, name: None) if chosen.no_pictures else eye
    hand = Keyboard() if chosen.keyboard else Hand()
    begin_s, before, problems = time.monotonic(), hand.total(), list[str]()
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        # Its policies need no pretrained weights. Looking at an episode takes longer than 20 s.
        own = (ROOT / "configs/so101_pick_cube.yaml").read_text(encoding="utf-8")
        own = own if chosen.no_pictures else own.replace(_LONGEST, _PATIENT)
        (folder / "my_arm.yaml").write_text(own, encoding="utf-8")
        with ui_process(folder) as address, look.browser() as chromium:
            page = look.opened(chromium, address)
            page.context.set_default_timeout(_WAIT_MS)
            page.on("pageerror", lambda error: problems.append(str(error)))
            page.get_by_text(said(page, "No problems found.")).wait_for()
            try:
                for stage in stages(hand, page, look_at, chosen.episodes):
                    now = hand.total()
                    counts = {name: now[name] - before[name] for name in now}
                    print(stage, counts, f"{time.monotonic() - begin_s:.0f} s", flush=True)
                    before = now
                    if stage == "launch the policy":
                        written = (folder / "my_arm.yaml").read_text(encoding="utf-8")
                        (folder / "my_arm.yaml").write_text(written.replace(_PATIENT, _LONGEST), encoding="utf-8")
            except BaseException:
                page.screenshot(path=chosen.folder / "failed.png", full_page=True)
                raise
            if not chosen.no_pictures:
                other = look.opened(chromium, address)
                until(other, "ibrobot.session.views.length")
                for name in other.evaluate("ibrobot.session.views.map(({name}) => name)"):
                    look.view(other, name)
                    look_at(other, f"filled-{name}")
    print("all", hand.total(), f"{eye.wrong} serious or critical", *problems, sep="\n")
    sys.exit(1 if eye.wrong or problems or hand.lost else 0)


if __name__ == "__main__":
    main()

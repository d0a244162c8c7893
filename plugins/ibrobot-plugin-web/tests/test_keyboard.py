"""The pages by keys alone, in headless Chromium: what is replaced does not lose the focus; what cards of runs say."""

from __future__ import annotations

import shutil
import subprocess
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from ibrobot_core.app import installed_plugins

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
pytestmark = [
    pytest.mark.integration,
    pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: apt-get install chromium"),
    pytest.mark.skipif(("hardware", "mujoco") not in installed_plugins().entries, reason="needs ibrobot-plugin-mujoco"),
]
REPLACED = """async ([before, after]) => {
  const { h, refresh } = await import("/static/dom.js");
  const place = h("div", {});
  document.body.append(place);
  const show = (texts) => refresh(place, texts, () => texts.map((text) => h("button", {}, text)));
  show(before);
  place.lastChild.focus();
  show(after);
  const focused = document.activeElement === place ? "the place" : document.activeElement.textContent;
  place.remove();
  return focused;
}"""
"""What has the focus after buttons of these texts, of which the last one had it, were replaced by others."""


FAILED = """async ([exit_code, lines]) => {
  const { JobCard } = await import("/static/ui/job.js");
  const card = new JobCard({ session: { views: [] }, drives: true });
  card.update({ number: 1, title: "arm", kind: "run", state: "failed", exit_code, facts: {}, lines });
  return card.error.textContent;
}"""
"""What the card of a failed run says of the cause."""
BEGUN = """() => {
  const { jobs } = ibrobot, arm = (number, facts) => ({ number, kind: "run", state: "running", facts, lines: [] });
  jobs.clear();
  const seen = [ibrobot.startsRun];
  jobs.set(1, arm(1, {}));
  seen.push(ibrobot.startsRun);
  jobs.set(1, arm(1, { url: "http://127.0.0.1/" }));
  seen.push(ibrobot.startsRun);
  ibrobot.begun = 2;
  seen.push(ibrobot.startsRun);
  return seen;
}"""
"""Whether a run starts: none, one without a page, one with a page, and one that was just asked for."""


def reach(page: Any, element: Any) -> None:
    """Go to an element by the tab key."""
    element.wait_for()
    for _ in range(120):
        if element.evaluate("each => each === document.activeElement"):
            assert element.evaluate("each => each.matches(':focus-visible')"), "the focus is visible"
            return
        page.keyboard.press("Tab")
    raise AssertionError(f"{element}: not reached by the tab key")


def test_focus_stays_and_cards_say_what_happened(tmp_path: Path) -> None:
    sync_api = pytest.importorskip("playwright.sync_api", reason="needs playwright: pip install playwright")
    from ui_path import FLAGS, own_robot, ui_process

    own_robot(tmp_path)
    with ui_process(tmp_path) as address, sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        page = browser.new_page()
        page.goto(address)
        page.get_by_text("No problems found.").wait_for(timeout=60_000)
        replaced = {
            ("Success", "Failure"): ("Failure", "Success"),
            ("Undo", "Play"): ("Play",),
            ("Failure", "Play"): ("Play", "Failure"),
        }
        for after, before in replaced.items():
            assert page.evaluate(REPLACED, [list(before), list(after)]) == before[-1]
        for others in ([], ["Discard"], ["Begin again"]):
            shown = page.evaluate(REPLACED, [["Redo", "Begin"], others])
            assert shown == "the place", "a key that is pressed twice presses nothing else"

        assert "by signal 9" in page.evaluate(FAILED, [-9, ["mode web | loop 100 Hz"]])
        assert page.evaluate(FAILED, [1, ["mode web | loop 100 Hz", "error: no arm"]]) == "exit code 1\nno arm"
        assert page.evaluate(BEGUN) == [False, True, False, True]

        reach(page, page.locator("#nav [data-name='job-datasets check']"))
        page.keyboard.press("Enter")
        page.locator("#view-job-datasets-check").wait_for()
        assert page.evaluate("document.activeElement.id") == "main"
        reach(page, page.get_by_role("link", name="Checks"))
        page.keyboard.press("Enter")
        reach(page, page.locator("#main").get_by_role("link", name="Check", exact=True))
        browser.close()


NEEDED = (("recorder", "mcap"), ("report", "check"))


@pytest.mark.skipif(
    any(each not in installed_plugins().entries for each in NEEDED),
    reason="needs ibrobot-plugin-mcap and ibrobot-plugin-diagnose",
)
def test_episodes_of_a_check_are_played_mended_and_restored_by_keys_alone(tmp_path: Path) -> None:
    sync_api = pytest.importorskip("playwright.sync_api", reason="needs playwright: pip install playwright")
    from made_runs import Run, record_run
    from page_run import IBROBOT
    from ui_path import FLAGS, ui_process, until

    demos = tmp_path / "pick" / "episodes"
    for number in range(1, 4):
        record_run(demos / f"episode_{number:06d}", Run(seed=number, acts=False, seconds=5, cameras=()))
    idle = record_run(demos / "episode_000009", Run(seed=9, acts=False, seconds=9, idle_s=4.0, cameras=()))
    check = ("datasets", "check", tmp_path / "pick", "--out", tmp_path / "checks/pick", "--jobs", "1")
    subprocess.run([*IBROBOT, *check], check=True, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL)

    def seconds() -> float:
        with closing(installed_plugins().open_episode(idle)) as reader:
            summary = reader.summary()
        return (summary.end_ns - summary.start_ns) / 1e9

    with ui_process(tmp_path) as address, sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        page = browser.new_page()
        page.context.set_default_timeout(180_000)  # each change is a command of its own
        page.goto(address)
        until(page, "window.ibrobot && ibrobot.session.views.length")

        def press(element: Any, shows: Any) -> None:
            """Press an element by keys, and wait for what it shows: the focus stays on the page."""
            reach(page, element)
            page.keyboard.press("Enter")
            shows.wait_for()
            until(page, "document.activeElement !== document.body")

        recording = page.get_by_role("region", name="Recording", exact=True)
        cut, drop = (recording.get_by_role("button", name=name) for name in ("Cut the first", "Drop"))
        undo = recording.get_by_role("button", name="Undo")
        press(page.locator("#nav [data-name='job-datasets check']"), page.get_by_role("link", name="Checks"))
        press(page.get_by_role("link", name="Checks"), page.get_by_role("link", name="checks/pick"))
        plays = page.get_by_role("button", name="Play the recording of 1. episode_000009")
        press(page.get_by_role("link", name="checks/pick"), plays)
        press(plays, recording.get_by_text("Nothing moves for"))
        until(page, "document.activeElement.textContent === '1. episode_000009'")
        assert seconds() > 8
        press(cut, undo)
        assert seconds() < 6
        press(undo, cut)
        assert seconds() > 8
        press(drop, undo)
        assert not idle.exists()
        press(undo, drop)
        assert idle.exists()
        reach(page, recording.get_by_role("button", name="Close"))
        page.keyboard.press("Enter")
        until(page, "document.activeElement.ariaLabel === 'Play the recording of 1. episode_000009'")
        browser.close()

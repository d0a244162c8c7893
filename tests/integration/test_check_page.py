"""The report of `ibrobot datasets check` on the page of `ibrobot ui`: one click or key mends, another undoes it.

By keys, what is replaced does not lose the focus.
"""

from __future__ import annotations

import shutil
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from made_episodes import make_episode

from ibrobot_core.app import installed_plugins

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
pytestmark = [
    pytest.mark.integration,
    pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: apt-get install chromium"),
    pytest.mark.skipif("datasets check" not in installed_plugins().commands, reason="needs ibrobot-plugin-diagnose"),
]


@pytest.fixture
def checked(tmp_path: Path) -> Path:
    """A folder with three episodes and a check that lists them."""
    from ibrobot_diagnose.check_contents import write_check

    def cause(name: str, mends: str, **facts: object) -> dict[str, object]:
        return {
            "name": name, "text": f"It is {name}.", "number": 1.0, "unit": "s", "threshold": 0.5, "likelihood": 0.9,
            "since_s": None, "details": [], "remedy": "Look at it.", "mends": mends, **facts,
        }  # fmt: skip

    outcomes = ("success", "unknown", "success")
    paths = [
        make_episode(tmp_path / f"pick/episodes/episode_00000{i}", 2.0, outcome=outcome)
        for i, outcome in enumerate(outcomes, 1)
    ]
    causes = (
        [cause("idle_start", "trim start", since_s=0.0), cause("idle_end", "trim end", since_s=1.6)],
        [cause("not_judged", "judge")],
        [cause("jerk", "drop")],
    )
    listed = [
        {"episode": str(path), "outcome": outcome, "seconds": 2.0, "causes": each}
        for path, outcome, each in zip(paths, outcomes, causes, strict=True)
    ]
    facts = {"dataset": "pick", "episodes": 3, "listed": listed, "counts": {"jerk": 1}, "unreadable": []}
    write_check(tmp_path / "checks/pick", facts, ["3 of 3 episodes to look at"], {})
    return tmp_path


def state(path: Path) -> tuple[float, str]:
    """Length [s] and outcome of an episode."""
    with closing(installed_plugins().open_episode(path)) as reader:
        summary = reader.summary()
    return round((summary.end_ns - summary.start_ns) / 1e9, 2), summary.outcome


def press(page: Any, element: Any, shows: Any) -> None:
    """Press an element by keys, and wait for what it shows: the focus stays on the page."""
    from ui_path import reach, until

    reach(page, element)
    page.keyboard.press("Enter")
    shows.wait_for()
    until(page, "document.activeElement !== document.body")


def mend_by_keys(page: Any, path: Path) -> None:
    """From the navigation to the player, in which an episode is dropped, restored, and cut."""
    from ui_path import reach, until

    press(page, page.locator("#nav [data-name='job-datasets check']"), page.get_by_role("link", name="Checks"))
    press(page, page.get_by_role("link", name="Checks"), page.get_by_role("link", name="checks/pick"))
    plays = page.get_by_role("button", name="Play the recording of 1. episode_000001")
    press(page, page.get_by_role("link", name="checks/pick"), plays)
    recording = page.get_by_role("region", name="Recording", exact=True)
    press(page, plays, recording.get_by_text("It is idle_start."))
    until(page, "document.activeElement.textContent === '1. episode_000001'")
    until(page, "document.querySelector('[aria-label=Recording] .clock').textContent.includes('2.00 s')")
    # Beside the player, which has the same buttons as the report.
    assert page.get_by_role("button", name="Drop: 1. episode_000001").count() == 2
    undo = recording.get_by_role("button", name="Undo")
    before, drop = state(path), recording.get_by_role("button", name="Drop")
    press(page, drop, undo)
    assert not path.exists()
    press(page, undo, drop)
    assert state(path) == before
    press(page, recording.get_by_role("button", name="Cut the first"), undo)
    assert state(path) == (1.0, "success")
    reach(page, recording.get_by_role("button", name="Close"))
    page.keyboard.press("Enter")
    until(page, "document.activeElement.ariaLabel === 'Play the recording of 1. episode_000001'")


def test_one_click_or_key_mends_an_episode_and_another_undoes_it(checked: Path) -> None:
    sync_api = pytest.importorskip("playwright.sync_api", reason="needs playwright: pip install playwright")
    from ui_path import FLAGS, SMALL, ui_process, until

    first, second = (checked / f"pick/episodes/episode_00000{i}" for i in (1, 2))
    errors: list[str] = []
    with ui_process(checked) as address, sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        page = browser.new_page(**SMALL)
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(address)
        until(page, "ibrobot.session.views.length")
        mend_by_keys(page, first)
        before = state(second)
        page.get_by_role("button", name="Judge failure: 2. episode_000002").first.click()
        undo = page.get_by_role("button", name="Undo what was done to 2. episode_000002").first
        undo.wait_for()
        assert state(second) == (2.0, "failure")
        undo.click()
        page.get_by_role("button", name="Judge failure: 2. episode_000002").first.wait_for()
        assert state(second) == before
        # Its times are no longer those of the check.
        cut = "Cut the first 0.8 s and the last 0.2 s"
        page.reload()
        until(page, "document.querySelector('.case')")
        assert page.get_by_role("button", name=f"{cut}: 1. episode_000001").count() == 0
        assert page.get_by_text("It has changed since the check.").count() == 1
        assert page.get_by_role("button", name="Drop: 3. episode_000003").count() == 1
        browser.close()
    assert errors == []

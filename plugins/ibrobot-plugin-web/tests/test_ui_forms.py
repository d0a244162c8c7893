"""Forms of the page of `ibrobot ui` remember what a person entered, in headless Chromium."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from ibrobot_core.app import installed_plugins

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
NEEDED = (("hardware", "mujoco"), ("recorder", "mcap"))
pytestmark = [
    pytest.mark.integration,
    pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: apt-get install chromium"),
    pytest.mark.skipif(
        any(each not in installed_plugins().entries for each in NEEDED),
        reason="needs ibrobot-plugin-mujoco and ibrobot-plugin-mcap",
    ),
]
WAIT_MS = 60_000


@contextmanager
def opened(folder: Path) -> Iterator[Any]:
    """The page in a browser, in a folder with a robot and recordings `pick` and `place`."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="needs playwright: pip install playwright")
    from made_runs import Run, record_run
    from ui_path import FLAGS, SMALL, own_robot, ui_process

    own_robot(folder)
    for task in ("pick", "place"):
        record_run(folder / f"episodes/{task}/episodes/episode_000001", Run(seed=1, acts=False, seconds=2, cameras=()))
    with ui_process(folder) as address, sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        page = browser.new_page(**SMALL)
        page.context.set_default_timeout(WAIT_MS)
        page.goto(address)
        page.get_by_text("No problems found.").wait_for()
        yield page
        browser.close()


def form(page: Any, name: str) -> Any:
    """Go to a view as if the page had just been opened."""
    page.evaluate(f"location.hash = {name!r}")
    page.reload()
    found = page.locator(f"#view-{name} form")
    found.locator("#field-steps, #field-out, #field-prompt").first.wait_for(state="attached")
    return found


def test_forms_remember_what_was_entered_and_suggest_the_rest(tmp_path: Path) -> None:
    with opened(tmp_path) as page:
        convert = form(page, "job-convert")
        pick, place = (convert.get_by_role("checkbox", name=f"episodes/{task}") for task in ("pick", "place"))
        out, prompt = convert.locator("#field-out"), convert.locator("#field-prompt")
        pick.check()
        assert out.input_value() == "datasets/pick"
        convert.locator("summary").click()
        prompt.fill("pick the cube")
        convert.locator("#field-append").check()

        form(page, "job-convert")
        assert (pick.is_checked(), place.is_checked()) == (True, False)
        assert (prompt.input_value(), convert.locator("#field-append").is_checked()) == ("pick the cube", True)
        assert out.input_value() == "datasets/pick"
        pick.uncheck()
        place.check()
        assert out.input_value() == "datasets/place", "what was only suggested is suggested anew"
        out.fill("datasets/mine")

        shutil.rmtree(tmp_path / "episodes/place")
        form(page, "job-convert")
        assert place.count() == 0
        assert out.input_value() == "datasets/mine"
        assert pick.is_checked(), "the only recording that is left, as in a form that nobody touched"

        key = "entered convert"
        kept = json.loads(page.evaluate(f"localStorage[{key!r}]"))
        kept["removed"] = {"value": "x", "listed": False}
        kept["missing"] = {"value": "an answer that is none", "listed": True}
        page.evaluate("([key, kept]) => localStorage.setItem(key, kept)", [key, json.dumps(kept)])
        form(page, "job-convert")
        assert convert.locator("#field-missing").input_value() == "skip"
        assert prompt.input_value() == "pick the cube"

        train = form(page, "job-train")
        assert train.locator("#field-steps").input_value() == "5000", "each command has its own"
        train.locator("#field-steps").fill("50")
        form(page, "job-train")
        assert train.locator("#field-steps").input_value() == "50", "though there is no dataset to train on yet"

        record = form(page, "record")
        record.locator("#field-prompt").fill("stack")
        form(page, "record")
        assert record.locator("#field-prompt").input_value() == "stack"
        assert page.evaluate("Object.keys(JSON.parse(localStorage['entered record']))") == ["prompt"]

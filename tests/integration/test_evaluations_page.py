"""Evaluations on the page of `ibrobot ui`, in headless Chromium: the report, the videos and the recordings."""

from __future__ import annotations

import io
import shutil
from pathlib import Path
from typing import Any

import pytest
from made_episodes import make_episode
from PIL import Image

pytestmark = [
    pytest.mark.integration,
    pytest.mark.skipif(
        (CHROMIUM := shutil.which("chromium") or shutil.which("chromium-browser")) is None,
        reason="needs Chromium: apt-get install chromium",
    ),
]
WAIT_MS = 60_000
HOSTILE = '<img src="x" onerror="document.title = \'owned\'">'


def make_evaluation(out: Path) -> str:
    """An evaluation of a policy and one that fails twice, once filmed; returns its page of one file."""
    from ibrobot_eval.episodes import Place, Result, write
    from ibrobot_eval.film import encode
    from ibrobot_eval.page import as_page
    from ibrobot_eval.policies import Policy
    from ibrobot_eval.report import Report, write_report

    places = [{"cube_x": seed / 10, "cube_y": 0.1 * (seed % 3)} for seed in range(8)]
    policies = [Policy(label, "arm.yaml", label, "model", ()) for label in (HOSTILE, "hasty")]
    results = {
        each.label: [
            Result(seed, each.label == HOSTILE or seed > 1, 2.0 + seed, {}, (), places[seed], {}) for seed in range(8)
        ]
        for each in policies
    }
    pictures = []
    for shade in range(0, 250, 5):
        picture = io.BytesIO()
        Image.new("RGB", (64, 48), (shade, 80, 80)).save(picture, "JPEG")
        pictures.append(picture.getvalue())
    write(out / Place.of(Path(), policies[1], 0).video, encode(pictures, 25.0))
    make_episode(out / Place.of(Path(), policies[1], 0).episode, 1.0, outcome="failure")
    (out / "evaluation.json").write_text("{}")
    report = Report.of_simulation(policies, results, 0.1, until_decided=False)
    write_report(out, report)
    return as_page(out, report)


def test_an_evaluation_is_looked_at_on_the_page(tmp_path: Path) -> None:
    sync_api = pytest.importorskip("playwright.sync_api", reason="needs playwright: pip install playwright")
    from ui_path import FLAGS, SMALL, plays, ui_process, until

    written = make_evaluation(tmp_path / "night")
    (tmp_path / "broken").mkdir()
    for name in ("evaluation.json", "report.json"):
        (tmp_path / "broken" / name).write_text("{}")
    errors: list[str] = []
    with ui_process(tmp_path) as address, sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        page = browser.new_context(**SMALL).new_page()
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("console", lambda line: errors.extend([line.text] * (line.type == "error")))
        page.goto(address)
        page.get_by_role("link", name="Results").click()
        page.get_by_text("broken/report.json: is not a report of an evaluation").wait_for(timeout=WAIT_MS)
        page.get_by_role("link", name="night").click()
        page.get_by_role("heading", name="Failures (2)").wait_for(timeout=WAIT_MS)
        check_same(page, written)
        until(page, "document.querySelector('video')?.readyState >= 2")  # its first picture is there
        assert page.evaluate("document.querySelector('video').duration") == pytest.approx(2.0, abs=0.1)
        assert page.locator("video").count() == 1
        command = page.get_by_text("--mode hasty --seed 0 --episodes 1")
        assert command.inner_text().startswith("ibrobot record arm.yaml --sim --lockstep --headless")
        page.get_by_role("button", name="Play the recording of hasty, seed 0").click()
        plays(page)
        assert page.title() == "ibrobot: Results"
        browser.close()
    assert not errors


def check_same(page: Any, written: str) -> None:
    """The page shows what the file shows: its tables, plots, texts and failures."""
    other = page.context.new_page()
    other.set_content(written)
    texts = ("svg text", "svg title", ".verdict", ".note", "td")
    shown, expected = (
        each.evaluate(
            "(parts) => [...document.querySelectorAll(parts)].map((each) => each.textContent).sort()",
            ", ".join(f"{root} {part}" for part in parts),
        )
        for each, root, parts in ((page, ".report", (*texts, "tbody th")), (other, "body", texts))
    )
    assert shown == expected
    shapes = ":is(circle, path, rect, line, polygon, polyline)"
    assert page.locator(f".report svg {shapes}").count() == other.locator(f"svg {shapes}").count()
    assert page.locator(".case").count() == other.locator(".failure").count() == 2
    other.close()

"""The page of `ibrobot ui` in headless Chromium: from choosing a robot to its dataset without a terminal."""

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
pytestmark = [
    pytest.mark.integration,
    pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: apt-get install chromium"),
    pytest.mark.skipif(("hardware", "mujoco") not in installed_plugins().entries, reason="needs ibrobot-plugin-mujoco"),
]


@contextmanager
def held(page: Any, address: str) -> Iterator[None]:
    """Answer no requests to an address meanwhile."""
    waiting: list[Any] = []
    holds = True
    page.route(address, lambda route: waiting.append(route) if holds else route.continue_())
    yield
    holds = False
    for route in waiting:
        route.continue_()


def look_on_a_phone(page: Any) -> None:
    """The navigation is one row, and each row of a table is a card whose values have the names of their columns."""
    page.set_viewport_size({"width": 390, "height": 844})
    page.locator("#nav [data-name='episodes']").click()
    page.get_by_role("link", name="episode_000001").wait_for()
    places = page.locator("#nav a").evaluate_all("(links) => links.map((each) => each.getBoundingClientRect().top)")
    assert max(places) - min(places) < 1
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    row = page.get_by_role("link", name="episode_000001").locator("xpath=ancestor::tr")
    cells = row.evaluate("(each) => [...each.cells].map((cell) => getComputedStyle(cell).display)")
    assert set(cells) == {"block"}
    named = row.locator("td").evaluate_all("(cells) => cells.map((each) => getComputedStyle(each, '::before').content)")
    assert '"Outcome: "' in named


def test_from_a_robot_to_its_dataset_without_a_terminal(tmp_path: Path) -> None:
    sync_api = pytest.importorskip("playwright.sync_api", reason="needs playwright: pip install playwright")
    from ui_path import FLAGS, SMALL, convert, own_robot, record, ui_process

    own_robot(tmp_path)
    errors: list[str] = []
    hosts: set[str] = set()
    with ui_process(tmp_path) as address, sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        page = browser.new_page(**SMALL)
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("console", lambda line: errors.extend([f"{line.text} {line.location}"] * (line.type == "error")))
        page.on("request", lambda request: hosts.add(request.url.split("/")[2]))
        page.goto(address)
        page.get_by_text("No problems found.").wait_for(timeout=60_000)
        for view in page.evaluate("ibrobot.session.views"):
            name, within = view["name"], view.get("within")
            if within:  # reached from the command that writes its reports
                page.locator(f"#nav [data-name='{within}']").click()
                page.locator("#main").get_by_role("link", name=view["title"], exact=True).click()
            else:
                page.locator(f"#nav [data-name='{name}']").click()
            page.locator(f"#view-{name.replace(' ', '-')}").wait_for(state="attached")
            assert page.locator("#nav [aria-current]").get_attribute("data-name") == (within or name)
        page.get_by_role("link", name="Robots", exact=True).click()
        page.get_by_text("No problems found.").wait_for()
        assert page.get_by_label("Robot", exact=True).input_value() == "my_arm.yaml", "one's own, not a shipped one"
        with held(page, "**/api/robots/check?*"):
            page.get_by_label("Robot", exact=True).select_option("so101")
            assert page.get_by_role("button", name="Launch").is_disabled()
        record(page)
        with held(page, "**/api/jobs/form?*"):
            page.locator("#nav").get_by_role("link", name="Convert", exact=True).click()
            assert page.get_by_role("button", name="Convert", exact=True).is_disabled()
        page.go_back()
        convert(page)
        look_on_a_phone(page)
        browser.close()
    assert not errors
    assert hosts == {address.split("/")[2]}
    outcomes = [
        (tmp_path / f"episodes/pick/episodes/episode_00000{number}/metadata.yaml").read_text() for number in (1, 2)
    ]
    assert ["success" in outcomes[0], "failure" in outcomes[1]] == [True, True]
    info = json.loads((tmp_path / "datasets/pick/meta/info.json").read_text())
    assert info["total_episodes"] == 1, "the success"

"""The pages by keys alone, in headless Chromium: what is replaced does not lose the focus; what cards of runs say."""

from __future__ import annotations

import shutil
from pathlib import Path

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


def test_focus_stays_and_cards_say_what_happened(tmp_path: Path) -> None:
    sync_api = pytest.importorskip("playwright.sync_api", reason="needs playwright: pip install playwright")
    from ui_path import FLAGS, SMALL, own_robot, reach, ui_process

    own_robot(tmp_path)
    with ui_process(tmp_path) as address, sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        page = browser.new_page(**SMALL)
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

"""Blinded trials on the page of `ibrobot ui`, in headless Chromium, with an emulated arm and camera."""

from __future__ import annotations

import json
import os
import shutil
import signal
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from blinded_arm import ARM, NAMES

if TYPE_CHECKING:
    from ibrobot_testing.site import Site

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
pytestmark = [
    pytest.mark.integration,
    pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: apt-get install chromium"),
]
WAIT_MS = 90_000
MODELS = ("model_one", "model_two")


class Seen:
    """All that an operator could see of the trials at the page: answers of the server, and the page itself."""

    def __init__(self, page: Any) -> None:
        self._page = page
        self._looks: list[str] = []
        self._answers: list[Any] = []
        self.errors: list[str] = []
        page.on("response", lambda answer: self._answers.extend([answer]))
        page.on("websocket", lambda socket: socket.on("framereceived", lambda frame: self._looks.append(str(frame))))
        page.on("pageerror", lambda error: self.errors.append(str(error)))
        page.on("console", lambda line: self._looks.append(line.text))

    def look(self) -> None:
        """See the page as it is."""
        self._looks.append(self._page.content())

    def texts(self) -> list[str]:
        """What was seen, without the operator's own command."""
        answers = [each for each in self._answers if "json" in each.headers.get("content-type", "")]
        assert {"list", "form?command=eval", "session"} <= {each.url.rpartition("/")[2] for each in answers}
        heads = [f"{each.url} {json.dumps(each.headers)}" for each in self._answers]
        texts = [*self._looks, *heads, *(each.text() for each in answers)]
        return [text.replace("--mode=careful --mode=hasty", "") for text in texts]


def start(page: Any, folder: str = "blind") -> None:
    page.get_by_role("link", name="Evaluate", exact=True).click()
    page.get_by_label("arm.yaml").check()
    page.get_by_label("Modes").fill(", ".join(NAMES))
    page.get_by_label("Episodes", exact=True).fill("2")
    page.get_by_label("Folder").fill(folder)
    page.get_by_role("button", name="Evaluate", exact=True).click()


def question(page: Any, text: str) -> None:
    page.locator(".ask .request").filter(has_text=text).wait_for(timeout=WAIT_MS)


def judge(page: Any, number: int, key: str) -> None:
    """Begin a trial and judge it, both by keys."""
    question(page, f"trial {number} (")
    page.keyboard.press("Enter")
    question(page, "outcome")
    page.keyboard.press(key)


def crash(folder: Path) -> None:
    """Kill the processes of the evaluation."""
    killed = []
    for each in Path("/proc").glob("[0-9]*"):
        try:
            words = (each / "cmdline").read_bytes().split(b"\0")
            if (each / "cwd").resolve() == folder and b"eval" in words:
                killed.append(int(each.name))
        except OSError:
            continue
    assert killed
    for pid in killed:
        os.kill(pid, signal.SIGKILL)


def first_day(page: Any, seen: Seen, folder: Path) -> None:
    """Two trials, by keys and by buttons, and a crash in the third."""
    from ui_path import until

    start(page)
    question(page, "trial 1 (start 1 of 2), set the scene to start 1")
    assert page.get_by_label("top: opacity of the start").count() == 0, "there is no picture of the start yet"
    until(page, "document.querySelector('.layers canvas')?.width === 64")  # the live picture
    page.keyboard.press("s")  # answers nothing here
    seen.look()
    judge(page, 1, "s")
    question(page, "trial 2 (start 1 of 2), set the scene to start 1 as in the picture")
    until(page, "document.querySelector('.layers canvas')?.width === 64")
    until(page, "document.querySelector('.layers img.over')?.naturalWidth === 64")
    page.get_by_label("top: opacity of the start").fill("80")
    assert page.evaluate("getComputedStyle(document.querySelector('.over')).opacity") == "0.8"
    seen.look()
    page.get_by_role("button", name="Begin the trial").click()
    question(page, "outcome")
    seen.look()
    page.get_by_role("button", name="Void").click()
    page.get_by_label("trial 2 is void; reason").fill("the light went out, s")
    page.keyboard.press("Enter")
    question(page, "trial 3 (start 1 of 2)")
    page.keyboard.press("Enter")
    question(page, "outcome")
    crash(folder)
    page.locator(".job .state.failed").wait_for(timeout=WAIT_MS)
    assert page.locator(".ask:visible").count() == 0, "nobody is asked any more"


def second_day(page: Any, seen: Seen) -> None:
    """The other trials, until the last one runs."""
    page.get_by_role("button", name="Evaluate", exact=True).click()  # the form is still filled in
    judge(page, 3, "f")
    question(page, "trial 4 (start 2 of 2)")
    page.get_by_role("link", name="Episodes").click()
    page.get_by_text("No episodes in the opened folders").wait_for(timeout=WAIT_MS)
    seen.look()
    page.get_by_role("link", name="Evaluate", exact=True).click()
    page.get_by_role("button", name="Begin the trial").click()
    question(page, "outcome")
    page.keyboard.press("Escape")  # the emergency stop
    question(page, "trial 4 has ended")
    page.get_by_role("button", name="Failure").click()
    question(page, "trial 5 (start 2 of 2)")
    page.get_by_role("button", name="Begin the trial").click()
    question(page, "outcome")
    seen.look()


@pytest.mark.long
def test_operator_judges_blind_on_the_page_and_goes_on_after_a_crash(site: Site, tmp_path: Path) -> None:
    sync_api = pytest.importorskip("playwright.sync_api", reason="needs playwright: pip install playwright")
    from ui_path import FLAGS, ui_process

    site.add("ibrobot-reaching", "reaching_arm.py")
    folder = tmp_path / "opened"
    folder.mkdir()
    out = folder / "blind"
    camera = "peripherals:\n  - {name: top, kind: camera, type: made_up_camera}\n"
    (folder / "arm.yaml").write_text(ARM + camera, encoding="utf-8")
    with ui_process(folder) as address, sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        page = browser.new_page()
        seen = Seen(page)
        page.goto(address)
        first_day(page, seen, folder)
        second_day(page, seen)
        blind = [*seen.texts(), (out / "trials.log").read_text(encoding="utf-8")]
        blind += [str(path.relative_to(out)) for path in out.rglob("*")]
        page.keyboard.press("f")
        page.locator(".job .state.done").wait_for(timeout=WAIT_MS)
        check_report(out)
        file = sorted((out / "trials").glob("*.json"))[-1]
        file.write_text(json.dumps(json.loads(file.read_text()) | {"seal": "0"}))
        page.get_by_role("button", name="Evaluate", exact=True).click()
        page.get_by_text("so they are not blind").wait_for(timeout=WAIT_MS)
        browser.close()
    assert not seen.errors
    for name in (*NAMES, *MODELS):
        assert not [text for text in blind if name in text]


def check_report(out: Path) -> None:
    trials = [json.loads(each.read_text()) for each in sorted((out / "trials").glob("*.json"))]
    assert [each["outcome"] for each in trials] == ["success", "void", "failure", "failure", "failure"]
    assert trials[1]["reason"] == "the light went out, s"
    assert [bool(each["faults"]) for each in trials] == [False, False, False, True, False], "one was stopped"
    report = json.loads((out / "report.json").read_text())
    assert sorted((each["label"], each["successes"], each["episodes"]) for each in report["policies"]) in (
        [("careful", 0, 2), ("hasty", 1, 2)],
        [("careful", 1, 2), ("hasty", 0, 2)],
    )
    assert len(list((out / "episodes").glob("trial_*"))) == 5
    pictures = sorted(str(each.relative_to(out)) for each in (out / "starts").rglob("*.jpg"))
    assert pictures == ["starts/start_0001/top.jpg", "starts/start_0002/top.jpg"]
    assert not (out / ".unfinished").exists(), "no live picture stays"

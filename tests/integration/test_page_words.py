"""Chinese words of what others declare: labels, helps and events of installed commands, and each shipped robot."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import attrs
import pytest
from ibrobot_provenance.asking import Ask
from ibrobot_provenance.processes import Jobs
from ibrobot_web.server.app import STATIC
from ibrobot_web.ui.context import Ui
from ibrobot_web.ui.folders import Folders
from ibrobot_web.ui.forms import form_of, job_commands
from ibrobot_web.ui.robots import listing

from ibrobot_core.app import installed_plugins
from ibrobot_core.events import Event

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
pytestmark = pytest.mark.integration
ENTRY = re.compile(r'^  ("(?:[^"\\]|\\.)*"): ', re.MULTILINE)


KNOWN = {json.loads(each) for each in ENTRY.findall((STATIC / "words/zh.js").read_text(encoding="utf-8"))}


def test_every_summary_of_a_shipped_robot_is_in_the_table(tmp_path: Path) -> None:
    robots = listing(Ui(Folders([tmp_path]), Jobs(tmp_path)))
    assert len(robots) > 5
    assert [each["summary"] for each in robots if each["summary"] not in KNOWN] == []


def test_every_text_of_a_form_is_in_the_table(tmp_path: Path) -> None:
    ui = Ui(Folders([tmp_path]), Jobs(tmp_path))
    assert len(job_commands()) > 5
    for command in job_commands():
        form = form_of(ui, command)
        texts = [form["summary"]]
        for field in form["fields"]:
            help_ = field["help"][:1].upper() + field["help"][1:]
            texts += [text for value, text in field["choices"] if text != value and " " in text]  # the others are names
            texts += [field["label"], *([help_] if help_.casefold() != field["label"].casefold() else [])]
        missing = [text for text in texts if text and not {text, f"{text} (required)"} & KNOWN]
        assert missing == [], command


CARD = """async (job) => {
  const { JobCard } = await import("/static/ui/job.js");
  const card = new JobCard({ session: { views: [] }, drives: true });
  card.update({ number: 1, title: "b", kind: "convert", lines: [], ...job });
  return [card.facts.textContent, card.error.textContent, card.problems.textContent];
}"""
"""What the card of a job says: its state, why it failed, and what went wrong with parts of it."""
VALUES: dict[Any, tuple[Any, ...]] = {
    int: (1, 3), float: (2.5, 90.0), bool: (False, True), str: ("X",), tuple[str, ...]: ((), ("X",)),
    int | None: (None, 3), float | None: (None, 2.5, 90.0),
}  # fmt: skip
LINES = {
    "Nothing was found in 4 episodes.": "没有发现问题",
    "a  2 of 4 succeeded, 95 % interval 7 to 93 %, median 3.1 s; a is better than b; "
    "b  0 of 4 succeeded, 95 % interval 0 to 60 %": "a 优于 b; b",
    "pick/a: Nothing is wrong with the set-up; more or better data is what helps: X": "设置没有问题",
    "1 of 2 episodes; pick/a: Nobody judged this episode.": "1 / 2 个回合; pick/a: 没有人评判过这个回合",
    "so101: 1 fail, 0 warn, 2 uncertain, 9 ok; there is no reference to compare with.": "没有可比较的参考",
    "Nobody judged this episode.\nNothing was found in 4 episodes.": "没有人评判过这个回合",
}
"""Lines that commands make of what they found -> a part of what the card says."""


def made_up(kind: type[Event]) -> Iterator[Event]:
    """Events of a kind with different values."""
    for i in range(3):
        values = {
            each.name: VALUES[each.type]
            for each in attrs.fields(attrs.resolve_types(kind))
            if i or each.default is attrs.NOTHING
        }
        yield kind(**{name: each[min(i, len(each) - 1)] for name, each in values.items()})


@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: apt-get install chromium")
def test_what_jobs_say_is_in_the_language_of_the_page(tmp_path: Path) -> None:
    sync_api = pytest.importorskip("playwright.sync_api", reason="needs playwright: pip install playwright")
    from ui_path import FLAGS, ui_process

    commands = installed_plugins().commands
    kinds = {kind for name in (*job_commands(), "record") for kind in commands[name].events} - {Ask}
    shown = [event.shown() for kind in sorted(kinds, key=str) for event in made_up(kind)]
    english = re.compile(r"[A-Za-z]{2,} [a-z]{2,}")
    with ui_process(tmp_path) as address, sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        page = browser.new_page(locale="zh-CN")
        page.goto(address)

        def card(**job: Any) -> list[str]:
            said: list[str] = page.evaluate(CARD, {"state": "running", "facts": {}, **job})
            return said

        for each in shown:
            said = card(facts={"text": each.text, "problems": [each.problem] if each.problem else []})
            assert english.search("".join(said)) is None, each
        for line, words in LINES.items():
            said = card(facts={"text": line})
            assert words in said[0]
            assert english.search(said[0]) is None, said
        unknown = "X has no word there; Y has none"
        assert card(facts={"text": unknown})[0] == unknown
        found = "X is dark. [3 %; warns from 2, fails from 4]\nWhat to do: Nobody judged this episode."
        assert re.search(
            r"从 2 起警告.从 4 起不合格]\n怎么办.没有人评判过这个回合", card(facts={"problems": [found]})[2]
        )
        assert card(state="failed", exit_code=3, lines=["error: no arm"])[1] == "退出码 3\nno arm"
        browser.close()
    assert len(shown) > 20

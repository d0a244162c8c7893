"""Chinese words of what others declare: each label and help of installed commands, and each shipped robot."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from ibrobot_provenance.processes import Jobs
from ibrobot_web.server.app import STATIC
from ibrobot_web.ui.context import Ui
from ibrobot_web.ui.folders import Folders
from ibrobot_web.ui.forms import form_of, job_commands
from ibrobot_web.ui.robots import listing

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

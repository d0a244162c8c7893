"""Mistakes in every section of a robot YAML: one error with line and key, the same from `config check` and `launch`.

`malformed/robot.yaml` is good; `malformed/cases.yaml` has edits, one mistake each.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

from ibrobot_core.cli.main import main

FOLDER = Path(__file__).parent / "malformed"
GOOD = (FOLDER / "robot.yaml").read_text()
CASES: list[dict[str, Any]] = yaml.safe_load((FOLDER / "cases.yaml").read_text())

pytestmark = pytest.mark.integration


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("IBROBOT_FOLLOWER_PORT", "IBROBOT_LEADER_PORT", "IBROBOT_TOP_CAMERA", "IBROBOT_WRIST_CAMERA"):
        monkeypatch.delenv(name, raising=False)


def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[object, str]:
    """Exit code and standard error."""
    monkeypatch.setattr(sys, "argv", ["ibrobot", *arguments])
    with pytest.raises(SystemExit) as end:
        main()
    return end.value.code, capsys.readouterr().err


def test_there_are_many_and_the_file_without_them_is_good(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("robot.yaml").write_text(GOOD)
    assert len({(case["old"], case["new"]) for case in CASES}) >= 120
    for sim in ((), ("--sim",)):
        code, err = run(monkeypatch, capsys, "config", "check", "robot.yaml", *sim)
        assert (code or 0, err) == (0, "")


@pytest.mark.parametrize("case", CASES, ids=lambda case: case["told"][:60])
def test_one_error_and_the_same_from_both(
    case: dict[str, Any], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert GOOD.count(case["old"]) == 1
    Path("robot.yaml").write_text(GOOD.replace(case["old"], case["new"]))
    sim = ("--sim",) if case.get("sim") else ()

    checked = run(monkeypatch, capsys, "config", "check", "robot.yaml", *sim)
    launched = run(monkeypatch, capsys, "launch", "robot.yaml", "--dry-run", *sim)

    assert checked == launched
    code, err = checked
    assert code == 2
    [line] = err.splitlines()
    assert line.startswith(f"error: robot.yaml:{case['told']}")

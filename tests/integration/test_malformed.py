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


@pytest.mark.parametrize("case", CASES, ids=lambda case: case["message"][:60])
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
    assert line.startswith(f"error: robot.yaml:{case['message']}")


MODEL = """\
<mujoco>
  <worldbody>
    <body><joint name="pan" range="-60 60"/><geom size="0.1"/><site name="tip"/></body>
  </worldbody>
  <actuator><position joint="pan" kp="1"/></actuator>
</mujoco>
"""
SIMULATED = """\
robot:
  name: mini
  joints: [{name: pan, lower: -1.0, upper: 1.0, max_velocity: 2.0, max_acceleration: 10.0}]
  groups: {arm: [pan]}
  description: {mjcf: model.xml, tip: tip, poses: {rest: [0]}}
simulation: {type: mujoco, scene: empty}
executors: {arm: {type: position, group: arm}}
control_modes: {idle: {executors: [arm]}}
default_control_mode: idle
"""


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("", "", ""),
        ('<position joint="pan" kp="1"/>', '<motor joint="pan"/>', "has no position actuator for joint 'pan'"),
        ("<joint name", "<joint nick", "unrecognized attribute: 'nick'"),
        ('<joint name="pan" range="-60 60"/>', "", "has no joint 'pan'; it has:"),
        ("<geom size", "<gemo size", "unrecognized element"),
    ],
)
def test_model_that_mujoco_refuses(
    old: str, new: str, message: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("robot.yaml").write_text(SIMULATED)
    Path("model.xml").write_text(MODEL.replace(old, new) if old else MODEL)

    checked = run(monkeypatch, capsys, "config", "check", "robot.yaml")
    launched = run(monkeypatch, capsys, "launch", "robot.yaml", "--dry-run")

    assert checked == launched
    code, err = checked
    assert (code or 0) == (2 if message else 0), err
    assert message in err
    assert len(err.splitlines()) == bool(message)
    assert err.startswith("error: robot.yaml:6: simulation: ") or not message

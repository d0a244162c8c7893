"""`ibrobot config copy`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from click.testing import CliRunner, Result
from fake_runs import site
from ibrobot_testing.command import command_line
from ibrobot_testing.terminal import Terminal

if TYPE_CHECKING:
    from ibrobot_testing.site import Site

config_copy = command_line("config copy")

__all__ = ["site"]

ROBOT = """\
# my arm ${NOT_A_VARIABLE}
robot:
  name: mini
  joints:
    - {name: pan, lower: -1.0, upper: 1.0, max_velocity: 2.0, max_acceleration: 10.0}
  groups: {arm: [pan]}
executors:  # one
  arm: {type: position, group: arm}
control_modes:
  idle: {executors: [arm]}
default_control_mode: idle
hardware: {type: fake_arm, port: "${MINI_PORT:/dev/null}"}
"""


@pytest.fixture
def source(site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    site.add("fake-arm", "cli_arm.py")
    monkeypatch.chdir(tmp_path)
    path = Path("mini.yaml")
    path.write_text(ROBOT)
    return path


def copy(*arguments: str) -> Result:
    return CliRunner().invoke(config_copy, ["mini.yaml", "desk.yaml", *arguments])


def test_the_copy_has_the_same_text_except_for_the_values_given(source: Path) -> None:
    ran = copy("--value", "MINI_PORT=/dev/zero")
    assert ran.output.startswith("desk.yaml: ok (mini, 1 joint, hardware)\n")
    assert Path("desk.yaml").read_text() == source.read_text().replace("/dev/null", "/dev/zero")


def test_it_overwrites_nothing(source: Path) -> None:
    Path("desk.yaml").write_text("mine")
    assert "exists already, and is not overwritten" in str(copy().exception)
    assert Path("desk.yaml").read_text() == "mine"


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("MINI_PROT=/dev/zero", "mini.yaml has no variable 'MINI_PROT'; its variables are: MINI_PORT"),
        ("NOT_A_VARIABLE=1", "its variables are: MINI_PORT"),
        ("MINI_PORT=a}, x: {", "'a}, x: {' cannot be a default: no spaces, quotes, braces or #"),
        ("MINI_PORT", "expected NAME=VALUE, got 'MINI_PORT'"),
        ("MINI_PORT=", "expected NAME=VALUE, got 'MINI_PORT='"),
    ],
)
def test_a_wrong_value_writes_nothing(source: Path, value: str, message: str) -> None:
    ran = copy("--value", value)
    assert message in f"{ran.output}{ran.exception}"
    assert not Path("desk.yaml").exists()


def test_faults_of_the_copy_are_reported(source: Path) -> None:
    source.write_text(source.read_text().replace("lower: -1.0", "lower: 3.0"))
    assert "desk.yaml:5: robot.joints.pan" in str(copy().exception)


def test_it_asks_in_a_terminal_for_each_variable(source: Path) -> None:
    with Terminal("config", "copy", "mini.yaml", "desk.yaml") as terminal:
        terminal.wait_for('port: "${MINI_PORT:/dev/null}"')
        terminal.wait_for("MINI_PORT [/dev/null]")
        terminal.type("/dev/full\r")
        terminal.wait_for("desk.yaml: ok")
        assert terminal.end() == 0
    assert "${MINI_PORT:/dev/full}" in Path("desk.yaml").read_text()


@pytest.mark.parametrize(
    ("target", "message"),
    [("mini.yaml", "exists already, and is not overwritten"), ("lab/desk.yaml", "there is no folder lab")],
)
def test_a_file_that_cannot_be_made_is_refused_before_the_questions(source: Path, target: str, message: str) -> None:
    with Terminal("config", "copy", "mini.yaml", target) as terminal:
        terminal.wait_for(message)
        assert terminal.end() == 2
        assert "MINI_PORT [" not in terminal.screen


def test_a_variable_of_the_environment_is_the_usual_answer_and_outranks_another(
    source: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MINI_PORT", "/dev/zero")
    with Terminal("config", "copy", "mini.yaml", "desk.yaml") as terminal:
        terminal.wait_for("MINI_PORT [/dev/zero]")
        terminal.type("\r")
        terminal.wait_for("desk.yaml: ok")
        assert terminal.end() == 0
    assert "${MINI_PORT:/dev/zero}" in Path("desk.yaml").read_text()
    with Terminal("config", "copy", "mini.yaml", "other.yaml", "--value", "MINI_PORT=/dev/full") as terminal:
        terminal.wait_for("note: MINI_PORT=/dev/zero of the environment outranks the file")
        assert terminal.end() == 0

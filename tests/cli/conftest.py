"""The command line run in this process, with a made-up arm installed."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import attrs
import pytest

from ibrobot_core.cli.main import main

if TYPE_CHECKING:
    from ibrobot_testing.site import Site

ROBOT = """\
robot:
  name: mini
  joints:
    - {name: pan, lower: -1.0, upper: 1.0, max_velocity: 2.0, max_acceleration: 10.0}
  groups: {arm: [pan]}
hardware: {type: fake_arm, port: /dev/null}
executors:
  arm: {type: position, group: arm}
control_modes:
  idle: {executors: [arm]}
default_control_mode: idle
"""


@attrs.frozen
class Ran:
    """What a command printed, and its exit code."""

    code: int
    out: str
    err: str


@pytest.fixture
def robot(site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A robot YAML in the working directory, and the plugin that it needs."""
    site.add("fake-arm", "cli_arm.py")
    monkeypatch.chdir(tmp_path)
    path = Path("mini.yaml")
    path.write_text(ROBOT)
    return path


@pytest.fixture
def ibrobot(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., Ran]:
    def run(*arguments: str) -> Ran:
        monkeypatch.setattr(sys, "argv", ["ibrobot", *arguments])
        code: object = 0
        try:
            main()
        except SystemExit as end:
            code = end.code or 0
        assert isinstance(code, int)
        out, err = capsys.readouterr()
        return Ran(code, out, err)

    return run

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
    from conftest import Site

ARM = '''
import attrs, click
from ibrobot_core import hookimpl
from ibrobot_core.descriptors import Command, HardwareDescriptor, SensorDescriptor
from ibrobot_core.errors import HardwareError
from ibrobot_core.options import option

@attrs.frozen
class Servo:
    id: int = option(help="number on the bus")

@attrs.frozen
class Options:
    port: str = option(help="serial port")
    max_speed: float = option(3.0, unit="rad/s", gt=0, le=6.5, help="speed limit of the servos")
    mode: str = option("soft", choices=("soft", "hard"), help="how it holds")
    servos: tuple[Servo, ...] = option((), help="what differs from the default")
    offset: float | None = option(None, unit="rad", help="of the base")

@hookimpl
def ibrobot_hardware():
    yield HardwareDescriptor("fake_arm", lambda options, ctx: None, "an arm of thin air", Options)

@hookimpl
def ibrobot_sensors():
    yield SensorDescriptor("fake_arm", lambda options, ctx: None, "the camera in its hand")

@click.command()
def greet():
    """Say hello."""
    raise HardwareError("nobody there")

@hookimpl
def ibrobot_commands():
    yield Command("greet", "Say hello.", lambda: greet)
'''
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
    site.add("fake-arm", ARM)
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

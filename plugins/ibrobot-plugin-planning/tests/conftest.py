"""Runs of a robot in lockstep, with made-up hardware."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from ibrobot_testing.site import made_up_site

from ibrobot_core.app import LaunchRequest, Runtime, Session, installed_plugins, load_config

ROBOT = """\
robot:
  name: mini
  joints:
    - {name: pan, lower: -1.0, upper: 1.0, max_velocity: 2.0, max_acceleration: 10.0}
    - {name: grip, lower: -1.0, upper: 1.0, max_velocity: 2.0, max_acceleration: 10.0}
  groups: {arm: [pan], gripper: [grip]}
  description:
    poses: {home: [0, 0], up: [0.4, 0.2]}
hardware: {type: arm}
simulation: {type: scene}
executors:
  arm_trajectory: {type: trajectory, group: arm}
  waypoints: {type: waypoints, group: arm}
  gripper: {type: gripper, group: gripper}
control_modes:
  plan: {executors: [arm_trajectory], planner: {type: joint}}
  all: {executors: [arm_trajectory, gripper], planner: {type: joint}}
  foreign: {executors: [waypoints], planner: {type: cubic}}
  idle: {executors: [arm_trajectory]}
default_control_mode: plan
control: {rate_hz: 50, stop: hold}
"""
Make = Callable[..., Runtime]


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """The made-up hardware is installed, discovered once for the tests of a file."""
    folder = tmp_path_factory.mktemp("made_up") / "site"
    with pytest.MonkeyPatch.context() as patch, made_up_site(folder, Path(__file__).parent, patch) as site:
        site.add("parts", "parts.py")
        yield


@pytest.fixture
def make(tmp_path: Path, parts: None) -> Iterator[Make]:
    """Makes runs of a robot YAML (`mini` where none is given); stops those that a test leaves running."""
    made: list[Runtime] = []

    def make_run(*overrides: str, text: str = ROBOT, mode: str | None = None, **asked: Any) -> Runtime:
        path = tmp_path / "robot.yaml"
        path.write_text(text)
        registry = installed_plugins()
        config = load_config(path, overrides=overrides, mode=mode, sim=True, registry=registry)
        made.append(Runtime(Session(config, registry, LaunchRequest(**{"lockstep": True, **asked}))))
        return made[-1]

    yield make_run
    for runtime in made:
        runtime.stop()


@pytest.fixture
def start(make: Make) -> Make:
    """As `make`, and starts them."""

    def started(*overrides: str, **asked: Any) -> Runtime:
        runtime = make(*overrides, **asked)
        runtime.start()
        return runtime

    return started

"""Runs of a small robot whose every part is a fake, offered by one made-up distribution."""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Iterator
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

import attrs
import pytest
from ibrobot_testing.site import Site, made_up_site

from ibrobot_core.config import load_config
from ibrobot_core.interfaces.run import LaunchRequest
from ibrobot_core.launch.runtime import Runtime
from ibrobot_core.launch.session import Session
from ibrobot_core.plugins import discover

PLUGINS = Path(__file__).parent / "plugins"
"""Made-up plugins, each a module."""

ROBOT = textwrap.dedent("""\
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
    peripherals:
      - {name: top, kind: camera, type: webcam}
      - {name: side, kind: camera, type: webcam}
    executors:
      arm_position: {type: position, group: arm}
      grip_position: {type: position, group: gripper}
      arm_trajectory: {type: waypoints, group: arm}
    models:
      net: {type: net}
      lost: {type: lost}
    control_modes:
      policy:
        executors: [arm_position, grip_position]
        inference: {model: net}
        dispatch: {watermark: 5}
      lost: {executors: [arm_position, grip_position], inference: {model: lost}}
      teleop: {executors: [arm_position, grip_position], teleop: stick}
      plan: {executors: [arm_trajectory], planner: {type: cubic}}
      replan: {executors: [arm_trajectory], planner: {type: cubic}}
      idle: {executors: [arm_position]}
    default_control_mode: policy
    teleoperation:
      stick: {type: stick}
      lever: {type: lever}
    contract:
      rate_hz: 25
      max_duration_s: 1
      observations:
        - {key: observation.state, topic: /joint_states, select: [position.pan, position.grip]}
        - {key: observation.images.top, peripheral: top, align: {strategy: asof, tol_ms: 100}}
      actions:
        - {executor: arm_position, topic: /arm/commands}
        - {executor: grip_position, topic: /grip/commands}
    control: {rate_hz: 50, stop: hold}
    """)


@attrs.define
class Runs:
    """Makes runs, and stops those that a test leaves running. `parts` is the module of the fakes."""

    folder: Path
    site: Site
    made: list[Runtime] = attrs.field(factory=list)
    installed: list[EntryPoint] = attrs.field(factory=list)
    """Plugins that are not made up."""

    @property
    def parts(self) -> Any:
        return sys.modules["fake_parts"]

    def make(self, *overrides: str, mode: str | None = None, sim: bool = True, **asked: Any) -> Runtime:
        """A run in lockstep, unless `asked` says otherwise; not started."""
        path = self.folder / "mini.yaml"
        path.write_text(ROBOT)
        if not self.installed and any("recording=" in each or "intervene" in each for each in overrides):
            pytest.importorskip("ibrobot_data")
            self.installed += entry_points(group="ibrobot", name="data")
        registry = discover([*self.site.entry_points(), *self.installed])
        config = load_config(path, overrides=overrides, mode=mode, sim=sim, registry=registry)
        runtime = Runtime(Session(config, registry, LaunchRequest(**{"lockstep": True, **asked})))
        self.made.append(runtime)
        return runtime

    def start(self, *overrides: str, **asked: Any) -> Runtime:
        """As `make`, and started."""
        runtime = self.make(*overrides, **asked)
        runtime.start()
        return runtime


@pytest.fixture
def runs(site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Runs]:
    monkeypatch.chdir(tmp_path)
    site.add("fake-parts", PLUGINS / "launch_parts.py")
    made = Runs(tmp_path, site)
    yield made
    for runtime in made.made:
        runtime.stop()


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    """An empty site, seen by this process and by those that it starts; `installed_plugins()` discovers again."""
    with made_up_site(tmp_path / "site", PLUGINS, monkeypatch) as site:
        yield site


def finish(runtime: Runtime) -> None:
    """Run to the end, and stop."""
    while not runtime.step():
        pass
    runtime.stop()


def seconds(runtime: Runtime, duration: float) -> None:
    """Run for a time [s]."""
    for _ in range(round(duration * runtime.session.config.control.rate_hz)):
        runtime.step()

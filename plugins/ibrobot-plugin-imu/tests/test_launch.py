"""The simulated SO-101 moved by an emulated sensor through the launch path, in lockstep."""

from __future__ import annotations

import json
import queue
import re
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import attrs
import numpy as np
import pytest
import yaml

from ibrobot_core.api import Vector
from ibrobot_core.app import LaunchRequest, Runtime, Session, installed_plugins, load_config

from .sensor import Sensor

pytestmark = [
    pytest.mark.integration,
    pytest.mark.skipif(find_spec("ibrobot_mujoco") is None, reason="needs ibrobot-plugin-mujoco"),
]
ROOT = Path(__file__).parents[3]
CONFIG = ROOT / "configs" / "so101_blind.yaml"


def documented(block: int) -> list[str]:
    """The overrides that add what a YAML of the how-to says to a robot."""
    page = (ROOT / "docs" / "how-to" / "drive-with-an-imu.md").read_text(encoding="utf-8")
    found = yaml.safe_load(re.findall(r"```yaml\n(.*?)```", page, re.DOTALL)[block])
    return [f"{section}.{name}={json.dumps(value)}" for section, each in found.items() for name, value in each.items()]


@attrs.define
class Run:
    """A run with a sensor, and a person who holds keys."""

    sensor: Sensor
    keys: list[queue.SimpleQueue[str]] = attrs.field(factory=list)
    runtime: Runtime = attrs.field(init=False)
    down: set[str] = attrs.field(factory=set)
    """The keys that are held."""

    def subscribe(self) -> queue.SimpleQueue[str]:
        self.keys.append(queue.SimpleQueue())
        return self.keys[-1]

    def ticks(self, count: int, *held: str, **tilt: float) -> None:
        events = [f"release:{key}" for key in self.down - {*held}] + [key for key in held if key not in self.down]
        self.down = {*held}
        for _ in range(count):
            self.sensor.turn(**tilt)
            for typed in self.keys:
                for event in events:
                    typed.put(event)
            events = [f"repeat:{key}" for key in held]
            assert not self.runtime.step()

    @property
    def position(self) -> Vector:
        return self.runtime.session.measured().position.copy()

    @property
    def tool(self) -> Vector:
        """Where the tip is [m]."""
        from ibrobot_kinematics import robot_model

        robot = self.runtime.session.config.robot
        arm = robot.groups["arm"]
        return robot_model(robot, arm).forward(self.position[robot.indices(arm)]).position


@pytest.fixture
def run() -> Iterator[Run]:
    """The mode `imu` in which the keyboard moves the gripper, from the pose `home`."""
    registry = installed_plugins()
    with Sensor("bno08x") as sensor:
        overrides = [
            *documented(0),
            *documented(2),
            f"teleoperation.imu.port={sensor.port}",
            "simulation.start_pose=home",
        ]
        config = load_config(CONFIG, sim=True, mode="imu", overrides=overrides, registry=registry)
        made = Run(sensor)
        made.runtime = Runtime(Session(config, registry, LaunchRequest(lockstep=True, keys=made.subscribe)))
        made.runtime.start()
        made.ticks(10)
        yield made
        made.runtime.stop()


def test_tilting_moves_the_tool_and_keys_the_gripper(run: Run):
    lines = "\n".join(run.runtime.plan.lines())
    assert "teleop imu (imu) moves arm, keyboard (keyboard) moves gripper" in lines
    before, there = run.tool, run.position
    run.ticks(60, pitch=0.7)
    np.testing.assert_allclose(run.tool, before, atol=2e-3)

    run.ticks(5, "z")
    run.ticks(60, "z", yaw=-0.7)
    run.ticks(30, "z")
    way = run.tool - before
    assert way[2] < -0.03, "the tool went down"
    assert np.hypot(way[0], way[1]) < 0.02
    assert run.position[5] == pytest.approx(there[5], abs=0.02)

    held = run.tool
    run.ticks(40, "o")
    np.testing.assert_allclose(run.tool, held, atol=3e-3)
    assert run.position[5] > there[5] + 0.1
    assert run.runtime.session.faults == ()


def test_garbage_in_motion_holds(run: Run):
    run.ticks(5, "z")
    run.ticks(40, "z", yaw=-0.7)
    rng = np.random.default_rng(1)
    for _ in range(60):
        run.sensor.send(rng.bytes(19))
        for typed in run.keys:
            typed.put("repeat:z")
        run.runtime.step()
    held = run.position
    run.ticks(30, "z", yaw=-0.7)
    np.testing.assert_allclose(run.position, held, atol=2e-3)
    assert run.runtime.session.faults == ()

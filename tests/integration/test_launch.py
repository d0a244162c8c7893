"""`ibrobot launch` on the simulated SO-101: its summary, exit codes, real time, faults, dry run."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from command_line import run_here

if TYPE_CHECKING:
    from tests.integration.conftest import Log, Ran

pytestmark = pytest.mark.integration


def test_scripted_pick_succeeds_and_the_summary_is_the_last_line(launch: Callable[..., Ran]):
    ran = launch("--lockstep", "--episodes", "3", "--seed", "40")
    assert ran.code == 0, ran.err
    summary = ran.summary
    assert (summary["episodes"], summary["successes"], summary["faults"]) == (3, 3, [])
    assert summary["loop"].keys() >= {"rate_hz", "lateness_p50_us", "lateness_p99_us", "missed"}
    assert summary["loop"]["rate_hz"] == 100.0
    assert summary["counters"]["safety"]["nonfinite"] == 0
    assert summary["drops"] == {}
    assert "episode 3: success" in ran.err


def test_one_episode_in_real_time(launch: Callable[..., Ran]):
    ran = launch("--episodes", "1", "--set", "contract.max_duration_s=100")
    assert ran.code == 0, ran.err
    summary = ran.summary
    assert (summary["episodes"], summary["successes"], summary["faults"]) == (1, 1, [])
    assert not summary["lockstep"]
    assert summary["loop"]["ticks"] > 200
    assert "mode model_inference | loop " in ran.err, "plain lines while it runs"


def test_the_whole_robot_with_its_cameras_in_lockstep(launch: Callable[..., Ran], rendering: None):
    kept = "recording={type: mcap, root: kept, dataset: pick}"  # without a receiver, they would render nothing
    ran = launch("--lockstep", "--duration", "1.5", "--set", kept, robot="so101")
    assert ran.code == 0, ran.err
    summary = ran.summary
    assert summary["rates_hz"].keys() == {"top", "wrist"}
    assert all(rate == pytest.approx(30.0, rel=0.05) for rate in summary["rates_hz"].values())


def test_an_episode_that_fails_is_exit_code_3(launch: Callable[..., Ran]):
    ran = launch("--lockstep", "--episodes", "1", "--set", "contract.max_duration_s=1")
    assert ran.code == 3, ran.err
    assert (ran.summary["episodes"], ran.summary["successes"]) == (1, 0)


@pytest.mark.parametrize(("mode", "has_episodes"), [("moveit_planning", False), ("model_inference", True)])
def test_only_a_run_of_a_policy_counts_episodes_that_nothing_judged(mode: str, has_episodes: bool):
    goal = ("--goal", "rest") if mode == "moveit_planning" else ()
    done = run_here("launch", "so101_blind", "--sim", "--lockstep", "--headless", "--duration", "1",
                    "--mode", mode, *goal)  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert ("\nepisodes   1, of which 0 succeeded, 1 not judged\n" in done.stdout) == has_episodes
    assert ("\nepisodes " in done.stdout) == has_episodes


def test_a_fault_is_named_and_the_run_holds_until_its_end(recorded: Callable[..., tuple[Ran, list[Log]]]):
    faults = "simulation.faults=[{at: 1.0, kind: read_error}]"
    ran, _ = recorded("--lockstep", "--duration", "3", "--set", faults)
    assert ran.code == 1, ran.err
    (fault,) = ran.summary["faults"]
    assert fault == "simulation: reading failed (injected fault read_error)"
    assert f"fault: {fault}; the robot holds" in ran.err
    assert ran.summary["duration_s"] >= 3.0, "it went on, holding"


def test_a_fault_in_real_time(launch: Callable[..., Ran]):
    ran = launch("--duration", "2", "--set", "simulation.faults=[{at: 0.5, kind: silent}]")
    assert ran.code == 1, ran.err
    (fault,) = ran.summary["faults"]
    assert "the joints do not answer: no state for " in fault


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--mode", "moveit_planning", "--goal", "hom"), "goal 'hom': no pose 'hom'; the poses are: home, rest"),
        (("--mode", "moveit_planning", "--goal", "wrist=1"), "goal 'wrist=1': no joint 'wrist'; the joints are: "),
        (("--goal", "home"), "--goal needs a mode with a planner: --mode moveit_planning"),
        (("--mode", "teleoperation"), "teleoperation"),
        (("--set", "control.rate=50"), "control.rate: unknown key"),
        (("--window",), "--window and --headless exclude each other"),
    ],
    ids=["pose", "joint", "no planner", "mode", "key", "options"],
)
def test_a_wrong_command_line_is_exit_code_2(launch: Callable[..., Ran], arguments: tuple[str, ...], message: str):
    ran = launch("--lockstep", *arguments)
    assert ran.code == 2
    assert message in ran.err
    assert "Traceback" not in ran.err
    assert ran.out == ""


def test_a_component_that_cannot_start_is_exit_code_1(launch: Callable[..., Ran]):
    ran = launch("--lockstep", "--mode", "teleop")
    assert ran.code == 1
    (line,) = [line for line in ran.err.splitlines() if line.startswith("error: ")]
    assert line.startswith("error: mode:teleop: ")
    assert "terminal" in line
    assert "Traceback" not in ran.err


def test_dry_run_prints_the_plan_and_starts_nothing(launch: Callable[..., Ran], rendering: None):
    ran = launch("--lockstep", "--dry-run", "--mode", "moveit_planning", "--goal", "home", robot="so101")
    assert (ran.code, ran.err) == (0, "")
    components = json.loads(ran.out)["components"]
    names = [component["name"] for component in components]
    assert names == [
        "control",
        "sensor:top",
        "sensor:wrist",
        "mode:moveit_planning",
        "status",
        "description",
        "goals",
        "guard",
        "tool_pose",
    ]
    assert "planner rrt_connect" in components[3]["summary"]


def test_an_episode_is_recorded_with_what_is_to_know_of_it(
    recorded: Callable[..., tuple[Ran, list[Log]]], tmp_path: Path
):
    ran, logs = recorded("--lockstep", "--episodes", "2", "--seed", "7")
    assert ran.code == 0, ran.err
    assert len(logs) == 2
    root, drawn = tmp_path / "kept" / "default" / "episodes", []
    for number, log in enumerate(logs, 1):
        metadata = json.loads((root / f"episode_{number:06d}" / "metadata.json").read_text())
        assert (metadata["outcome"], metadata["dropped"]) == ("success", {})
        assert metadata["metadata"]["seed"] == str(6 + number)
        assert metadata["metadata"]["mode"] == "model_inference"
        factors = json.loads(metadata["metadata"]["factors"])
        assert 0.20 <= math.hypot(factors["cube_x"], factors["cube_y"]) <= 0.27
        assert factors["light"] == 1.0
        drawn.append(factors["cube_x"])
        assert len(log.times) == metadata["samples"] > 200
        assert log.times[0] == pytest.approx(0.01)
        assert log.times[1:] - log.times[:-1] == pytest.approx(0.01), "no tick is lost, none is twice"
    assert len(set(drawn)) == 2, "both episodes have the factors of one"

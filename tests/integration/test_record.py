"""`ibrobot record` as a user runs it: unattended in simulation, and by keys in a terminal."""

from __future__ import annotations

import json
import subprocess
from contextlib import chdir
from pathlib import Path

import pytest
import yaml
from command_line import run_here
from ibrobot_testing.terminal import Terminal

from ibrobot_core.plugins import installed_plugins

HOLD_R = "\x1b[114;1:1;114u\x1b[114;1:2;114u"
"""A press and a repeat, from a terminal that reports both."""
pytestmark = pytest.mark.integration


def outcomes(folder: Path) -> list[tuple[str, str, int]]:
    """Outcome, prompt and number of joint states of each episode."""
    found = []
    for path in sorted((folder / "episodes").glob("episode_*")):
        reader = installed_plugins().open_episode(path)
        summary = reader.summary()
        reader.close()
        assert summary.finished
        found.append((summary.outcome, summary.metadata["prompt"], summary.topics["/joint_states"].count))
    return found


def test_simulated_episodes_are_recorded_unattended_with_the_scenes_judgement(tmp_path: Path):
    command = ["record", "so101_blind", "--sim", "--lockstep", "--headless", "--json", "--episodes", "3"]
    options = ["--dataset", "pick", "--prompt", "pick the cube", "--set", "contract.max_duration_s=4.5"]
    with chdir(tmp_path):
        done = run_here(*command, *options)
    summary = json.loads(done.stdout.splitlines()[-1])
    kept = outcomes(tmp_path / "episodes" / "pick")
    assert [outcome for outcome, _, _ in kept].count("success") == summary["successes"]
    assert {outcome for outcome, _, _ in kept} == {"success", "failure"}, "some are too slow for the time given"
    assert done.returncode == 3, done.stderr
    assert all(prompt == "pick the cube" and count > 400 for _, prompt, count in kept)
    dataset = yaml.safe_load((tmp_path / "episodes" / "pick" / "dataset.yaml").read_text())
    assert dataset["robot"] == "so101"


def test_resume_goes_on_to_the_number_of_episodes(tmp_path: Path):
    command = ["record", "so101_blind", "--sim", "--lockstep", "--headless", "--dataset", "pick"]
    with chdir(tmp_path):
        run_here(*command, "--continuous", "--mode", "moveit_planning", "--goal", "home", "--prompt", "go home")
        again = run_here(*command, "--resume", "--episodes", "2", "--set", "contract.max_duration_s=0.5")
        done = run_here(*command, "--resume", "--episodes", "2")
    assert "recorded   2 of 2 episodes into" in again.stdout
    assert [prompt for _, prompt, _ in outcomes(tmp_path / "episodes/pick")] == ["go home", "go home"]
    assert done.stdout == "episodes/pick: has 2 episodes already\n"


def is_recording(terminal: Terminal) -> None:
    """Wait for some of an episode; how many seconds are shown, a busy machine may skip."""
    for _ in range(5):
        terminal.wait_for("recording “wave”, ")


def test_an_operator_records_by_keys(tmp_path: Path):
    arguments = ("record", "so101_blind", "--sim", "--mode", "teleop", "--root", str(tmp_path), "--dataset", "desk")
    with Terminal(*arguments, columns=120) as terminal:
        terminal.wait_for("waiting: Tab starts")
        terminal.type("\t")
        terminal.wait_for("prompt (Enter alone leaves it empty")
        terminal.type("wave\r")
        terminal.wait_for("recording begins when the robot follows you")
        terminal.type(HOLD_R)
        is_recording(terminal)
        terminal.type("\t")
        terminal.wait_for("episode 1: success")
        terminal.type("\t")
        terminal.type(HOLD_R)
        is_recording(terminal)
        terminal.type("\x1b[24~")  # F12
        terminal.wait_for("episode 2: discarded")
        terminal.type("\x03")  # once: a second one ends it at once
        terminal.wait_for("recorded   1 episode into")
        assert terminal.end() == 0
    assert "\a" in terminal.screen
    (kept,) = outcomes(tmp_path / "desk")
    assert kept[:2] == ("success", "wave")


def test_without_a_terminal_it_says_what_to_add(tmp_path: Path, ibrobot: tuple[str, ...]):
    command = [*ibrobot, "record", "so101_blind", "--sim", "--headless", "--mode", "teleop"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 2
    assert "nothing can begin an episode: there is no terminal for keys, no device of mode teleop" in done.stderr

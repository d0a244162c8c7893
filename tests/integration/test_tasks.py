"""Tasks in the simulated SO-101: pick and place by planning, among obstacles, and by a policy."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from command_line import run_here
from ibrobot_data.commanders import Commanders
from ibrobot_data.ticks import Ticks
from ibrobot_planning.tasks.result import TaskResult
from pick_and_place import perform

from ibrobot_core.api import Contract, Vector
from ibrobot_core.app import LaunchRequest, Runtime, Session, find_config, installed_plugins, load_config

pytestmark = pytest.mark.integration

POLICY = """
steps:
  - record: {prompt: put the cube into the bin}
  - run_policy: {mode: scripted, seconds: 20, until: success}
  - look: {object: cube, near: bin_floor, within: 0.06}
  - move: {pose: rest}
"""


SIMULATED = ("so101_pick_cube", "--sim", "--lockstep", "--headless")


def test_bundled_task_picks_the_cube_and_puts_it_into_the_bin():
    done = run_here("task", "run", "pick_cube", *SIMULATED, "--json", "--seed", "4", "--param", "hover=0.08")
    assert done.returncode == 0, done.stderr
    task = json.loads(done.stdout.splitlines()[-1])["task"]
    assert (task["name"], task["outcome"], task["success"]) == ("pick the cube", "SUCCEEDED", True)
    assert [step["name"] for step in task["steps"]] == [
        "open",
        "down to the cube",
        "grasp",
        "lift",
        "over the bin",
        "release",
        "check",
        "back",
    ]
    assert task["steps"][6]["facts"]["distance_m"] < 0.06


def test_task_with_a_fault_starts_nothing(tmp_path: Path):
    path = tmp_path / "task.yaml"
    path.write_text("mode: planned\nsteps:\n- move: {object: cup}\n")
    fault = f"error: {path}:3: steps.0.move.object: unknown object 'cup'; known: table, cube, bin_floor"
    for command in (("run", path, *SIMULATED), ("check", path, "so101_pick_cube", "--sim")):
        done = run_here("task", *command)
        assert (done.returncode, done.stdout) == (2, "")
        assert fault in done.stderr
    done = run_here("task", "check", "pick_cube", "so101_pick_cube", "--sim")
    assert done.stdout == "pick_cube: 8 steps for so101, in mode planned\n"


def test_pick_and_place_among_obstacles_touches_nothing_and_repeats_exactly():
    first, again = perform(5), perform(5)
    assert (first.placed, first.touched, first.beyond, first.message) == (True, (), (), "")
    assert first.digest == again.digest


def perform_recorded(folder: Path, recorder: str, text: str) -> tuple[Runtime, TaskResult, list[Vector]]:
    """Perform a task that records; returns the commands of all ticks as well."""
    registry = installed_plugins()
    config = load_config(
        find_config("so101_pick_cube", registry),
        overrides=(f"recording={{type: {recorder}, root: {folder}}}", "tasks={}"),
        mode="planned",
        sim=True,
        registry=registry,
    )
    runtime = Runtime(Session(config, registry, LaunchRequest(lockstep=True, seed=1, by_operator=True)))
    commands = []
    runtime.start()
    try:
        number = runtime.session.bus.call("/task/run", text)
        while (result := runtime.session.bus.call("/task/result", number)) is None:
            assert not runtime.step()
            assert runtime.session.state is not None
            commands.append(runtime.session.state.command.copy())
    finally:
        runtime.stop()
    assert result.success, result.message
    return runtime, result, commands


def test_policy_in_a_task_is_recorded_until_the_scene_is_solved(tmp_path: Path):
    runtime, result, _ = perform_recorded(tmp_path, "joint_log", POLICY)
    assert result.steps[1].facts == {"success": True}
    assert (runtime.session.outcome.episodes, runtime.session.outcome.successes) == (1, 1)
    assert len(list((tmp_path / "default" / "episodes").iterdir())) == 1


MOTIONS = """
steps:
  - record: {prompt: turn and open, of: task}
  - move: {joints: {shoulder_pan: 0.3}}
  - gripper: {position: 0.6}
"""


def test_planned_motions_of_a_task_are_recorded_with_the_actions_of_the_contract(tmp_path: Path):
    _, _, commands = perform_recorded(tmp_path, "mcap", MOTIONS)
    reader = installed_plugins().open_episode(tmp_path / "default" / "episodes" / "episode_000001")
    try:
        summary = reader.summary()
        contract = Contract.from_canonical(json.loads(summary.metadata["contract"]))
        actions = [row["action"] for row in Ticks(reader, contract, "hold")]
        commander = Commanders(reader, summary).at(summary.start_ns)
    finally:
        reader.close()
    assert (summary.outcome, summary.metadata["prompt"], commander) == ("success", "turn and open", "planner")
    assert contract.features()["action"].names == (
        "shoulder_pan.pos",
        "shoulder_lift.pos",
        "elbow_flex.pos",
        "wrist_flex.pos",
        "wrist_roll.pos",
        "gripper.pos",
    )
    # Each action is what the robot was told at some tick, in order, from the start to the goals.
    told = np.array(commands, dtype=np.float32)
    found = [int(np.abs(told - action).max(axis=1).argmin()) for action in actions]
    assert all(np.array_equal(told[i], action) for i, action in zip(found, actions, strict=True))
    assert found == sorted(found)
    assert len(found) >= 0.9 * len(commands) * contract.rate_hz / 100
    assert actions[-1][[0, 5]] == pytest.approx([0.3, 0.6], abs=0.05)

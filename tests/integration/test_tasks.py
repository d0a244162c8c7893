"""Tasks in the simulated SO-101: pick and place by planning, among obstacles, and by a policy."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from command_line import run_here
from pick_and_place import perform

from ibrobot_core.api import LaunchRequest, Runtime, Session, find_config, installed_plugins, load_config

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
        "open", "above the cube", "down to the cube", "grasp", "lift", "over the bin", "release", "check", "back",
    ]  # fmt: skip
    assert task["steps"][7]["facts"]["distance_m"] < 0.06


def test_task_with_a_fault_starts_nothing(tmp_path: Path):
    path = tmp_path / "task.yaml"
    path.write_text("mode: planned\nsteps:\n- move: {object: cup}\n")
    fault = f"error: {path}:3: steps.0.move.object: unknown object 'cup'; known: table, cube, bin_floor"
    for command in (("run", path, *SIMULATED), ("check", path, "so101_pick_cube", "--sim")):
        done = run_here("task", *command)
        assert (done.returncode, done.stdout) == (2, "")
        assert fault in done.stderr
    done = run_here("task", "check", "pick_cube", "so101_pick_cube", "--sim")
    assert done.stdout == "pick_cube: 9 steps for so101, in mode planned\n"


def test_pick_and_place_among_obstacles_touches_nothing_and_repeats_exactly():
    """A short variant of `benchmarks/pick_and_place.py`."""
    first, again = perform(5), perform(5)
    assert (first.placed, first.touched, first.beyond, first.message) == (True, (), (), "")
    assert first.digest == again.digest


def test_policy_in_a_task_is_recorded_until_the_scene_is_solved(tmp_path: Path):
    registry = installed_plugins()
    recording = f"recording={{type: joint_log, root: {tmp_path}}}"
    config = load_config(
        find_config("so101_pick_cube", registry),
        overrides=(recording, "tasks={}"),
        mode="planned",
        sim=True,
        registry=registry,
    )
    runtime = Runtime(Session(config, registry, LaunchRequest(lockstep=True, seed=1, by_operator=True)))
    runtime.start()
    try:
        number = runtime.session.bus.call("/task/run", POLICY)
        while (result := runtime.session.bus.call("/task/result", number)) is None:
            assert not runtime.step()
    finally:
        runtime.stop()
    assert result.success, result.message
    assert result.steps[1].facts == {"success": True}
    assert (runtime.session.outcome.episodes, runtime.session.outcome.successes) == (1, 1)
    assert len(list((tmp_path / "default" / "episodes").iterdir())) == 1

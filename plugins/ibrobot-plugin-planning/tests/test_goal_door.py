"""The door of goals: what it says at the start, modes without a planner, and what it lets pass."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ibrobot_core.api import (
    FollowTrajectory,
    Header,
    IbrobotError,
    JointTrajectory,
    JointTrajectoryPoint,
    PlanningError,
    SlowDown,
    ns,
)

from .conftest import Make
from .table_arm import ARM
from .test_motion import robot_yaml

WALL_BOX = {"shape": "box", "size": [0.3, 0.02, 0.3], "position": [0.2, 0, 0.15]}


def to(*positions: float, at: float = 2.0, names: tuple[str, ...] = ARM) -> FollowTrajectory:
    return FollowTrajectory(JointTrajectory(Header(), names, (JointTrajectoryPoint(ns(at), np.array(positions)),)))


def test_without_a_model_goals_are_limited_and_the_run_says_so_once(start: Make, caplog: pytest.LogCaptureFixture):
    runtime = start(mode="idle")
    said = "goals of arm_trajectory, waypoints are limited, not checked against the world: robot.description.mjcf is"
    assert caplog.text.count(said) == 1
    runtime.step()
    with pytest.raises(PlanningError, match="its limit is 2 rad/s"):
        runtime.session.send_goal("arm_trajectory", "fast", to(0.9, at=0.1, names=("pan",)))
    runtime.session.send_goal("arm_trajectory", "slow", to(0.5, names=("pan",)))
    assert caplog.text.count("not checked") == 1


@pytest.mark.parametrize("mode", ["idle", "joint"])
def test_world_is_checked_in_modes_whose_planner_knows_none(start: Make, tmp_path: Path, mode: str):
    runtime = start(text=robot_yaml(tmp_path) + "world: {}\n", mode=mode)
    session = runtime.session
    runtime.step()
    session.send_goal("arm", "left", to(1.0, 0.8, 0.8, 0.5, 0.0, at=3.0))
    for _ in range(320):
        runtime.step()
    session.bus.call("/world/add", {"name": "wall", "object": WALL_BOX})
    with pytest.raises(PlanningError, match=r"the trajectory is not free: .*wall"):
        session.send_goal("arm", "right", to(-1.0, 0.8, 0.8, 0.5, 0.0, at=4.0))
    session.send_goal("arm", "up", to(1.0, 0.0, 0.0, 0.0, 0.0, at=3.0))


def test_padding_and_floor_of_the_section_goals(start: Make, tmp_path: Path):
    text = robot_yaml(tmp_path) + "goals: {floor: 0.04}\n"
    runtime = start(text=text, mode="idle")
    runtime.step()
    with pytest.raises(PlanningError, match="floor"):
        runtime.session.send_goal("arm", "down", to(0.0, 1.7, 0.0, 0.0, 0.0, at=4.0))


def test_object_of_its_name_does_not_take_the_place_of_the_floor(start: Make, tmp_path: Path):
    crumb = "{shape: box, size: [0.01, 0.01, 0.01], position: [3, 3, 3]}"
    text = robot_yaml(tmp_path) + f"goals: {{floor: 0.04}}\nworld: {{objects: {{floor: {crumb}}}}}\n"
    runtime = start(text=text, mode="idle")
    runtime.step()
    with pytest.raises(PlanningError, match="floor of the planner"):
        runtime.session.send_goal("arm", "down", to(0.0, 1.7, 0.0, 0.0, 0.0, at=4.0))


def test_executor_that_is_not_active_gets_no_goal(start: Make, tmp_path: Path):
    text = robot_yaml(tmp_path).replace("  idle: {executors: [arm]}", "  idle: {executors: [gripper]}")
    runtime = start(text=text, mode="idle")
    with pytest.raises(IbrobotError, match="executor 'arm' is not active in mode idle"):
        runtime.session.send_goal("arm", "one", to(*[0.0] * 5))


def test_arm_that_moves_without_a_goal_is_waited_for(start: Make, tmp_path: Path):
    """In lockstep nobody can wait: the goal is refused."""
    runtime = start(text=robot_yaml(tmp_path), mode="idle")
    runtime.step()
    runtime.session.send_goal("arm", "one", to(0.5, 0.0, 0.0, 0.0, 0.0))
    for _ in range(50):
        runtime.step()
    runtime.session.send_goal("arm", "stop", SlowDown())
    runtime.step()
    with pytest.raises(PlanningError, match="the joints still move"):
        runtime.session.send_goal("arm", "two", to(0.2, 0.0, 0.0, 0.0, 0.0))
    for _ in range(60):
        runtime.step()
    runtime.session.send_goal("arm", "two", to(0.2, 0.0, 0.0, 0.0, 0.0))

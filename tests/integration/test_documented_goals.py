"""Every goal of the documentation, by page, service, program, task, command line and ROS: all plan the same."""

from __future__ import annotations

import json
import queue
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from command_line import run_here
from ibrobot_kinematics.path_constraints import CONSTRAINT_KEYS
from ibrobot_planning.client import Client
from ibrobot_planning.execution.motions import commanded
from ibrobot_planning.execution.requests import PlanAhead
from ibrobot_planning.execution.services import PLAN_GOAL
from ibrobot_planning.execution.source import CMD_GOAL, MOTION_STATUS
from ibrobot_planning.tasks.reading import read_task
from ibrobot_planning.world.objects import World
from ibrobot_ros2 import decode, encode
from ibrobot_web.commands import Commands
from ibrobot_web.messages import Sent, from_page

from ibrobot_core.api import JointTrajectory, PlanningError, String
from ibrobot_core.app import LaunchRequest, Runtime, Session, find_config, installed_plugins, load_config

pytestmark = pytest.mark.integration
type Answer = tuple[list[float], float] | str
"""Positions at the end [rad] and duration [s], or why there is no plan."""

PAGE = Path(__file__).parents[2] / "docs/how-to/move-to-a-pose.md"
PLANNER = "control_modes.moveit_planning.planner={type: rrt_connect}"

_NEAR = "beyond_reach=nearest"
"""Five joints seldom reach an orientation."""
_TILTED = "upright=0.9"
"""In its pose `rest`, the tool is tilted by 45 degrees."""


def documented_goals() -> list[str]:
    """The goals in the table and the text of the section "Goals"; parts such as `axis=up` complete the goal before."""
    section = PAGE.read_text(encoding="utf-8").split("## Goals")[1].split("\n## ")[0]
    goals: list[str] = []
    for text in re.findall(r"`([^`]+)`", section):
        if re.match(r"(axis|quaternion)=", text):
            goals.append(" ".join((goals[-1].split()[0], text, *([_NEAR] if "quaternion" in text else []))))
        elif "=" in text or text == "home":
            goals.append(text if "rpy" not in text else f"{text} {_NEAR}")
        if "upright" in text:
            goals += [re.sub("upright=[0-9.]+", _TILTED, text), f"wrist_roll=0.5 {_TILTED} upright_axis=-z"]
    return goals


@contextmanager
def at_rest() -> Iterator[Runtime]:
    """A simulated SO-101 at rest in its pose `rest`."""
    registry = installed_plugins()
    overrides = ("simulation.scene=empty", "simulation.start_pose=rest", PLANNER)
    path = find_config("so101_blind", registry)
    config = load_config(path, sim=True, mode="moveit_planning", registry=registry, overrides=overrides)
    runtime = Runtime(Session(config, registry, LaunchRequest(lockstep=True)))
    try:
        runtime.start()
        Client.of_run(runtime).wait(0.1)
        yield runtime
    finally:
        runtime.stop()


@pytest.fixture(scope="module")
def run() -> Iterator[Runtime]:
    """A run in which nothing moves."""
    with at_rest() as runtime:
        yield runtime


def by_page(run: Runtime, goal: str) -> Answer:
    replies: queue.SimpleQueue[Mapping[str, Any]] = queue.SimpleQueue()
    commands = Commands(run.session, run.session.finish, replies.put, lambda error: replies.put({"error": str(error)}))
    try:
        sent: Sent[Any] = from_page(json.dumps({"do": "preview", "id": 1, "stops": 0, "goal": goal}))
        commands.take(sent)
        reply = replies.get(timeout=60)
    finally:
        commands.close(60)
    if "error" in reply:
        return reply["error"]
    assert reply["ok"]["joints"] == [0, 1, 2, 3, 4]
    return reply["ok"]["rows"][-1], reply["ok"]["duration_s"]


def by_service(run: Runtime, goal: str) -> Answer:
    answer = run.session.bus.call("/planning/plan", {"goal": goal})
    return answer.message or ended(answer.trajectory)


def by_program(run: Runtime, goal: str) -> Answer:
    try:
        return ended(Client.of_run(run).plan(goal))
    except PlanningError as error:
        return str(error)


def by_task(run: Runtime, goal: str) -> Answer:
    (step,) = read_task(yaml.safe_dump({"steps": [{"move": as_step(goal)}]}), "goal.yaml").task.steps
    assert step.move is not None
    robot = run.session.config.robot
    target = step.move.target(robot, robot.groups["arm"], World())
    answer = run.session.bus.call(PLAN_GOAL, PlanAhead(target))
    return answer.message or ended(answer.trajectory)


def as_step(goal: str) -> dict[str, Any]:
    """A goal as the step `move` takes it."""
    if "=" not in goal:
        return {"pose": goal}
    step: dict[str, Any] = {}
    pose, *_ = goal.split()
    if "=" not in pose:
        step["pose"], goal = pose, goal.removeprefix(f"{pose} ")
    for key, value in (each.split("=", 1) for each in re.split(r"[ ](?=[a-z])|,(?=[a-z])", goal)):
        if key in ("xyz", "axis", "rpy", "quaternion"):
            step[key] = value if value.isalpha() else [float(number) for number in value.split(",")]
        elif key == "beyond_reach":
            step[key] = value
        elif key in CONSTRAINT_KEYS:
            numbers = [float(number) for number in value.split(",")] if value[-1].isdigit() else value
            step.setdefault("path_constraints", {})[key] = numbers[0] if len(numbers) == 1 else numbers
        else:
            step.setdefault("joints", {})[key] = float(value)
    return step


def ended(trajectory: JointTrajectory | None) -> Answer:
    assert trajectory is not None
    last = trajectory.points[-1]
    return last.positions.tolist(), last.time_from_start_ns / 1e9


def by_command(goal: str) -> Answer:
    scene = ("--set", "simulation.scene=empty", "--set", PLANNER)
    done = run_here("plan", "so101_blind", "--sim", *scene, "--from", "rest", "--goal", goal, "--json")
    answer = json.loads(done.stdout)
    assert done.returncode == (0 if answer["success"] else 3)
    return answer["message"] or (list(answer["goal_joints"].values())[:5], answer["duration_s"])


def by_ros(goal: str) -> list[float] | None:
    """Positions where the arm comes to rest after a message as ROS sends it [rad]; None if it does not move."""
    with at_rest() as run:
        bus = run.session.bus
        seen = bus.subscribe(MOTION_STATUS, 1000)
        before = commanded(run.session)
        bus.publish(CMD_GOAL, decode(String.ros_type, encode(String(goal))))
        came: list[str] = []
        for _ in range(3000):
            run.step()
            came += [each.message.data for each in seen.drain() if isinstance(each.message, String)]
            if came[-1:] in (["succeeded"], ["failed"]):
                break
        reached = commanded(run.session)
        seen.close()
    if came[-1] == "succeeded":
        return reached[:5].tolist()
    np.testing.assert_array_equal(reached, before)
    return None


@pytest.mark.parametrize("goal", documented_goals())
def test_every_entrance_plans_the_same(run: Runtime, goal: str) -> None:
    answer = by_service(run, goal)
    assert by_program(run, goal) == answer
    if not ("xyz" in goal and "gripper" in goal):  # two steps of a task
        assert by_task(run, goal) == answer
    reached = by_ros(goal)
    assert (reached is None) == isinstance(answer, str)
    if reached is not None and not isinstance(answer, str):
        np.testing.assert_allclose(reached, answer[0], atol=2e-3)
    for other in (by_page(run, goal), by_command(goal)):
        if isinstance(answer, str) or isinstance(other, str):
            assert other == answer
        else:
            np.testing.assert_allclose(other[0], answer[0], atol=2e-3)
            assert other[1] == pytest.approx(answer[1], abs=0.02)
    assert not isinstance(answer, str) or "axis=down" in goal or "axis=up" in goal or "upright=0.17" in goal, (
        "five joints do not reach every direction, and the tool is not upright; all else is planned"
    )


def test_the_page_has_all_forms() -> None:
    goals = documented_goals()
    assert len(goals) >= 8
    for word in (
        "home",
        "wrist_flex=",
        "xyz=",
        "axis=down",
        "axis=up",
        "axis=0,0,-1",
        "rpy=",
        "quaternion=",
        "gripper=",
        "upright=",
        "region=",
    ):
        assert any(word in each for each in goals), word

"""Motions under way: new goals blend, obstacles that appear stop the arm, and lost joints are reported."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ibrobot_kinematics import robot_model
from ibrobot_planning.execution.source import GO_TO, RESULT
from ibrobot_planning.planners.blend import Limits, joined
from ibrobot_planning.planners.timing import timed
from ibrobot_planning.world.arm import robot_arm
from ibrobot_planning.world.collision import Collisions
from ibrobot_planning.world.objects import SNAPSHOT

from ibrobot_core.api import HardwareError, PlanCode, Vector
from ibrobot_core.app import Runtime

from .conftest import Make
from .table_arm import JOINTS
from .test_motion import RATE_HZ, assert_within_limits, command, finish, robot_yaml

PADDING = 0.005


@pytest.fixture
def run(start: Make, tmp_path: Path) -> Callable[..., Runtime]:
    def started(**asked: Any) -> Runtime:
        return start(text=robot_yaml(tmp_path) + "world: {}\n", **asked)

    return started


def step(runtime: Runtime, number: int, commands: list[Vector] | None = None) -> list[Vector]:
    commands = [] if commands is None else commands
    for _ in range(number):
        runtime.step()
        commands.append(command(runtime))
    return commands


def clearance(runtime: Runtime) -> float:
    """Distance of the measured arm from the objects of the world [m]."""
    world = runtime.session.bus.call(SNAPSHOT, None)
    checks = Collisions(robot_arm(runtime.session.config.robot), world, JOINTS, padding=1.0)
    assert runtime.session.state is not None
    contacts = checks.contacts(runtime.session.state.position)
    return min(each.distance for each in contacts if each.second in world.objects)


@pytest.mark.parametrize("mode", ["plan", "joint"])
def test_new_goal_blends_with_the_motion_under_way(run, mode: str):
    runtime = run(mode=mode)
    first = runtime.session.bus.call(GO_TO, "pan=1.0")
    commands = step(runtime, 25)
    second = runtime.session.bus.call(GO_TO, "pan=1.6,lift=0.4")
    replaced = step(runtime, 1)
    result = runtime.session.bus.call(RESULT, first)
    assert (result.outcome, result.code, result.message) == (
        "CANCELLED",
        PlanCode.PREEMPTED,
        "replaced by goal pan=1.6,lift=0.4",
    )
    commands += replaced
    assert finish(runtime, second, commands).success
    assert_within_limits(runtime, commands)
    np.testing.assert_allclose(command(runtime)[:2], [1.6, 0.4], atol=1e-6)
    speed = np.linalg.norm(np.diff(commands, axis=0), axis=1) * RATE_HZ
    assert speed[20:50].min() > 0.6 * speed[24], "it does not slow down for the next motion"


@pytest.mark.parametrize(
    ("refuse", "told"),
    [
        (":brake:", "the arm stops before its next motion: braking was refused: too fast"),
        ("2:arm", "the next motion of arm began after a stop: too fast"),
    ],
)
def test_refused_blend_is_reported_and_the_motion_begins_after_a_stop(
    run, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, refuse: str, told: str
):
    runtime = run()
    runtime.session.bus.call(GO_TO, "pan=1.0")
    commands = step(runtime, 25)
    call = runtime.session.control.call

    def refused(command: Any) -> Any:
        if type(command).__name__ == "SendGoal" and refuse in command.goal_id and command.goal.takes_over:
            raise HardwareError("too fast")
        return call(command)

    monkeypatch.setattr(runtime.session.control, "call", refused)
    assert finish(runtime, runtime.session.bus.call(GO_TO, "pan=1.6,lift=0.4"), commands).success
    assert_within_limits(runtime, commands)
    assert caplog.messages.count(told) == 1


def test_blends_end_exactly_at_rest():
    """Executors refuse others, and the arm would stop between the motions."""
    rng = np.random.default_rng(0)
    limits = Limits(np.full(5, -2.0), np.full(5, 2.0), np.full(5, 3.0), np.full(5, 10.0))
    for _ in range(10):
        a, b, c = rng.uniform(-1, 1, (3, 5))
        old, new = (
            timed(np.array(path), limits.velocity, limits.acceleration, blends=np.zeros(0), window=0.05, step=0.01)
            for path in ((a, b), (b, c))
        )
        way = next(joined(old, new, 0.1, limits))
        np.testing.assert_allclose(way.positions[-1], c, atol=1e-9)
        assert not way.velocities[-1].any()
        assert not way.accelerations[-1].any()


def test_new_goal_in_the_opposite_direction_blends_within_the_limits(run):
    runtime = run()
    runtime.session.bus.call(GO_TO, "left")
    commands = step(runtime, 40)
    assert finish(runtime, runtime.session.bus.call(GO_TO, "right"), commands).success
    assert_within_limits(runtime, commands)


def test_new_goal_that_cannot_be_planned_stops_the_arm(run):
    runtime = run()
    first = runtime.session.bus.call(GO_TO, "left")
    commands = step(runtime, 40)
    result = finish(runtime, runtime.session.bus.call(GO_TO, "xyz=2,0,0.1"), commands)
    assert (result.outcome, result.code) == ("PLANNING_FAILED", PlanCode.NO_IK_SOLUTION)
    assert runtime.session.bus.call(RESULT, first).outcome == "CANCELLED"
    step(runtime, 60, commands)
    assert_within_limits(runtime, commands)
    np.testing.assert_array_equal(commands[-1], commands[-2])
    assert finish(runtime, runtime.session.bus.call(GO_TO, "up"), commands).success


def test_goals_in_quick_succession_step_nowhere(run):
    runtime = run(seed=5)
    rng = np.random.default_rng(5)
    commands: list[Vector] = [command(runtime)]
    number = 0
    for _ in range(30):
        number = runtime.session.bus.call(GO_TO, f"pan={rng.uniform(-1.5, 1.5)},lift={rng.uniform(-0.8, 0.8)}")
        step(runtime, int(rng.integers(1, 30)), commands)
    assert finish(runtime, number, commands).success
    assert_within_limits(runtime, commands)
    assert runtime.summary()["goals_failed"] == 0


def test_equal_seeds_give_equal_blends(run):
    def ride() -> list[Vector]:
        runtime = run(seed=2)
        runtime.session.bus.call(GO_TO, "left")
        commands = step(runtime, 30)
        finish(runtime, runtime.session.bus.call(GO_TO, "xyz=0.2,-0.05,0.1"), commands)
        return commands

    np.testing.assert_array_equal(ride(), ride())


def test_obstacle_stops_a_motion_whose_goal_has_ended(run):
    """For example while the mode is switched."""
    runtime = run()
    number = runtime.session.bus.call(GO_TO, "left")
    step(runtime, 15)
    runtime.session.end_source()
    box = {"shape": "box", "size": [0.2, 0.02, 0.3], "position": [0.09, 0.13, 0.2], "rpy": [0, 0, 1.0]}
    runtime.session.bus.call("/world/add", {"name": "crate", "object": box})
    step(runtime, 100)
    assert clearance(runtime) > 0
    runtime.session.begin_source()
    assert runtime.session.bus.call(RESULT, number).outcome == "CANCELLED"


@pytest.mark.parametrize("mode", ["plan", "joint"])
def test_obstacle_that_appears_stops_the_arm_before_it(run, mode: str):
    """Also a motion of a planner that knows no obstacles."""
    runtime = run(mode=mode)
    number = runtime.session.bus.call(GO_TO, "left")
    commands = step(runtime, 15)
    box = {"shape": "box", "size": [0.2, 0.02, 0.3], "position": [0.09, 0.13, 0.2], "rpy": [0, 0, 1.0]}
    runtime.session.bus.call("/world/add", {"name": "crate", "object": box})
    result = finish(runtime, number, commands)
    assert (result.outcome, result.code.name) == (
        "EXECUTION_FAILED",
        "MOTION_PLAN_INVALIDATED_BY_ENVIRONMENT_CHANGE",
    )
    assert result.message.startswith("stopped before an obstacle: ")
    assert "crate" in result.message
    assert_within_limits(runtime, commands)
    step(runtime, 20, commands)
    np.testing.assert_array_equal(commands[-1], commands[-2])
    assert clearance(runtime) > PADDING
    runtime.session.bus.call("/world/remove", {"name": "crate"})
    assert finish(runtime, runtime.session.bus.call(GO_TO, "left"), commands).success


@pytest.mark.parametrize("ahead", [0.03, 0.012], ids=["in the way of braking", "at the arm"])
def test_obstacle_within_the_braking_distance_is_reported_as_such(run, ahead: float):
    """The arm cannot stop before it: the result says where it stands, and not that all is well."""
    runtime = run()
    number = runtime.session.bus.call(GO_TO, "pan=1.5,lift=1.2")
    for _ in range(500):
        runtime.step()
        if runtime.session.state.velocity[0] > 1.0:
            break
    robot = runtime.session.config.robot
    tip = robot_model(robot).forward(runtime.session.state.position)
    x, y = tip.position[0] - ahead * np.sin(runtime.session.state.position[0]), tip.position[1] + ahead
    size = {"shape": "box", "size": [0.3, 0.004, 0.5], "position": [x, y, 0.2]}
    runtime.session.bus.call("/world/add", {"name": "crate", "object": size})
    result = finish(runtime, number)
    assert result.code is PlanCode.MOTION_PLAN_INVALIDATED_BY_ENVIRONMENT_CHANGE
    step(runtime, 20)
    assert clearance(runtime) < PADDING, "it could not stop before"
    assert result.message.startswith("stopped too late for an obstacle within the braking distance: ")
    assert "crate" in result.message


def test_obstacle_elsewhere_does_not_stop_the_arm(run):
    runtime = run()
    number = runtime.session.bus.call(GO_TO, "left")
    step(runtime, 25)
    runtime.session.bus.call(
        "/world/add", {"name": "far", "object": {"shape": "sphere", "radius": 0.05, "position": [0, -0.6, 0]}}
    )
    assert finish(runtime, number).success


def test_lost_joint_is_reported_as_the_cause(run):
    runtime = run()
    number = runtime.session.bus.call(GO_TO, "left")
    step(runtime, 25)
    runtime.session.raise_fault("joint elbow does not answer")
    result = finish(runtime, number)
    assert (result.outcome, result.code) == ("EXECUTION_FAILED", PlanCode.CONTROL_FAILED)
    assert result.message == "joint elbow does not answer"

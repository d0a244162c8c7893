"""Targets beyond reach: the ordinary refusal, for every caller; what no robot means is refused as a request."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ibrobot_kinematics import robot_model
from ibrobot_kinematics.poses import pose
from ibrobot_kinematics.rotations import exp
from ibrobot_planning.execution.requests import GoTo, MoveToPose
from ibrobot_planning.execution.services import CARTESIAN, COMPUTE_IK, PLAN, PLAN_GOAL
from ibrobot_planning.execution.source import CMD_POSE, GO_TO, MOVE_ACTION, MOVE_TO_POSE
from ibrobot_planning.goals.tool import Tool
from ibrobot_planning.planner import PoseGoal, PositionGoal
from ibrobot_planning.planners.linear import linear_path
from ibrobot_planning.tasks.runner import RUN

from ibrobot_core.api import IbrobotError, PlanCode, PlanningError, Pose, Quaternion, Vector3
from ibrobot_core.app import ConfigError, Runtime

from .conftest import Make
from .table_arm import make_robot
from .test_motion import call, finish
from .test_plan_command import run as plan_command
from .test_plan_command import yaml  # noqa: F401 - a fixture
from .test_tasks import steps, task_robot

FAR = (2.0, 10.0, 1e3)
BEYOND = (1000.1, 1e6, 1e12, 1e100, 1e155, 1e200, 1e308)
"""No distance of a request [m]."""
NO_DISTANCE = "xyz must be numbers from -1000 to 1000"
MORE = ("", " axis=down", " rpy=3.14159,0,0", " rpy=0,0,0 beyond_reach=keep_axis")
DOWN = Quaternion(1.0, 0.0, 0.0, 0.0)


@pytest.fixture
def run(start: Make, tmp_path: Path) -> Runtime:
    return start(text=task_robot(tmp_path), by_operator=True)


@pytest.fixture(scope="module")
def tool(tmp_path_factory: pytest.TempPathFactory) -> Tool:
    return Tool(robot_model(make_robot(tmp_path_factory.mktemp("arm"))))


@pytest.mark.parametrize("far", FAR)
@pytest.mark.parametrize("more", MORE)
def test_goal_as_text(run: Runtime, far: float, more: str):
    for place in (f"{far},0,0", f"0.1,{-far},{far}"):
        result = finish(run, run.session.bus.call(GO_TO, f"xyz={place}{more}"))
        assert (result.outcome, result.code) == ("PLANNING_FAILED", PlanCode.NO_IK_SOLUTION)
        assert "the nearest is (" in result.message or "the nearest found is" in result.message
        assert len(result.message) < 400


@pytest.mark.parametrize("far", FAR)
def test_every_service(run: Runtime, far: float):
    bus: Any = run.session.bus
    goal = {"xyz": [far, 0, 0], "axis": [0, 0, -1]}
    for answer in (
        bus.call(COMPUTE_IK, {"goal": goal}),
        bus.call(PLAN, {"goals": [goal]}),
        bus.call(PLAN_GOAL, f"xyz={far},0,0"),
        bus.call(CARTESIAN, {"waypoints": [{"xyz": [0.2, 0, far]}], "least_fraction": 0.9}),
        bus.call(COMPUTE_IK, {"goal": {"xyz": [far, far, far], "quaternion": [1, 0, 0, 0], "beyond_reach": "nearest"}}),
    ):
        # A line is followed as far as possible, so one that is not much too long fails in planning.
        assert answer.code in (PlanCode.NO_IK_SOLUTION, PlanCode.PLANNING_FAILED)
        assert "cannot reach" in answer.message
    assert finish(run, bus.call(MOVE_ACTION, {"goals": [goal]})).code is PlanCode.NO_IK_SOLUTION
    assert call(run, MOVE_TO_POSE, MoveToPose(Pose(Vector3(far, 0, 0), DOWN))).code is PlanCode.NO_IK_SOLUTION


@pytest.mark.parametrize("far", FAR)
def test_task(run: Runtime, far: float):
    with pytest.raises(ConfigError, match=r"steps\.0\.move: NO_IK_SOLUTION: tip cannot reach"):
        run.session.bus.call(RUN, steps(f"move: {{xyz: [{far!r}, 0, 0.1], axis: down}}"))


@pytest.mark.parametrize("far", BEYOND)
def test_what_no_robot_means_is_no_request(run: Runtime, yaml: Path, far: float):  # noqa: F811
    bus: Any = run.session.bus
    goal = {"xyz": [far, 0, 0], "axis": [0, 0, -1]}
    for service, request in (
        *((GO_TO, f"xyz={far},0,0{more}") for more in MORE),
        (COMPUTE_IK, {"goal": goal}),
        (PLAN, {"goals": [goal]}),
        (CARTESIAN, {"waypoints": [{"xyz": [0.2, 0, far]}], "least_fraction": 0.9}),
        (MOVE_ACTION, {"goals": [goal]}),
        (RUN, steps(f"move: {{xyz: [{far!r}, 0, 0.1], axis: down}}")),
    ):
        with pytest.raises(IbrobotError, match=NO_DISTANCE):
            bus.call(service, request)
    answer = bus.call(PLAN_GOAL, f"xyz=0.1,{-far},0")
    assert answer.code is PlanCode.INVALID_GOAL_CONSTRAINTS
    assert NO_DISTANCE in answer.message
    failed = plan_command(yaml, "--from", "left", "--goal", f"xyz={far},0,0").exception
    assert NO_DISTANCE in str(failed)


@pytest.mark.parametrize("far", [*FAR, *BEYOND])
def test_cmd_pose(run: Runtime, far: float, caplog: pytest.LogCaptureFixture):
    run.session.bus.publish(CMD_POSE, Pose(Vector3(far, 0, 0), DOWN))
    for _ in range(10):
        run.step()
    assert "NO_IK_SOLUTION: " in caplog.text


@pytest.mark.parametrize("far", FAR)
def test_command_line(yaml: Path, far: float):  # noqa: F811
    result = plan_command(yaml, "--from", "left", "--goal", f"xyz={far},0,0")
    assert result.exit_code == 3
    assert "error: no plan: NO_IK_SOLUTION: tip cannot reach" in result.output


@pytest.mark.parametrize("value", ["inf", "-inf", "nan", "1e400"])
def test_numbers_that_are_none(run: Runtime, yaml: Path, value: str):  # noqa: F811
    with pytest.raises(PlanningError, match=f"xyz: '{value}' is not a finite number"):
        run.session.bus.call(GO_TO, f"xyz={value},0,0")
    failed = plan_command(yaml, "--from", "left", "--goal", f"xyz={value},0,0").exception
    assert isinstance(failed, PlanningError)
    assert f"xyz: '{value}' is not a finite number" in str(failed)
    number = float(value)
    for service, request in (
        (COMPUTE_IK, {"goal": {"xyz": [number, 0, 0]}}),
        (PLAN, {"goals": [{"xyz": [number, 0, 0]}]}),
        (MOVE_ACTION, {"goals": [{"xyz": [0, 0, number]}]}),
        (CARTESIAN, {"waypoints": [{"xyz": [number, 0, 0]}]}),
    ):
        with pytest.raises(IbrobotError, match=r"finite|number"):
            run.session.bus.call(service, request)
    goal = PositionGoal(Vector3(number, 0, 0))
    assert finish(run, run.session.bus.call(GO_TO, GoTo(goal))).code is PlanCode.INVALID_GOAL_CONSTRAINTS


@pytest.mark.parametrize("length", [1e-8, 1.0, 1e200, 1e308])
def test_direction_of_any_length(tool: Tool, length: float):
    """An axis is a direction: its length means nothing."""
    start = np.array([0.2, 0.8, 0.6, 0.5, 0.0, 0.0])
    tip = tool.model.forward(start)
    place, (x, y, z) = Vector3(*tip.position.tolist()), tip.rotation[:, 2].tolist()
    short, long = (tool.candidates(PositionGoal(place, Vector3(f * x, f * y, f * z)), start) for f in (1.0, length))
    np.testing.assert_allclose([each.joints for each in long], [each.joints for each in short], atol=1e-9)


ANGLES = st.floats(0.3, 0.9)


@settings(max_examples=30, deadline=None)
@given(
    joints=st.tuples(ANGLES, ANGLES, ANGLES, ANGLES),
    roll=st.floats(-2.6, -0.5),
    off=st.sampled_from([0.0, 1e-15, 1e-12, 1e-7, 1e-3]),
)
def test_half_a_turn_is_made_along_a_line(tool: Tool, joints: tuple[float, ...], roll: float, off: float):
    """About the axis of the tool, which has any direction: the tool turns evenly, to either side, as far as it can."""
    start = np.array([*joints, roll, 0.0])
    tip = tool.model.forward(start)
    placed = np.eye(4)
    placed[:3, :3], placed[:3, 3] = tip.rotation @ exp(np.array([0, 0, np.pi - off])), tip.position
    path = linear_path(tool, [PoseGoal(pose(placed), orientation_tolerance=0.02)], start)
    turned = path.joints[:, 4] - roll
    assert abs(turned[-1]) > 0.05, "it turns"
    assert np.abs(np.abs(turned) - np.arange(len(turned)) * np.pi / 63).max() < 0.02
    if turned[-1] > 0:
        assert path.reason == ""
        assert turned[-1] == pytest.approx(np.pi, abs=0.01)
    else:
        assert off < 1e-3, "the shorter way is the other one"
        assert "roll" in path.reason or "cannot reach" in path.reason


@pytest.mark.parametrize("flex", [-1.5, -0.4, 0.3, 1.2])
def test_opposite_axis_is_half_a_turn(tool: Tool, flex: float):
    """Not a jump at the end: the direction leaves the first one evenly, or the path ends with a reason."""
    start = np.array([0.3, 0.4, -0.6, flex, 0.2, 0.0])
    tip = tool.model.forward(start)
    away = Vector3(*(-tip.rotation[:, 2]).tolist())
    path = linear_path(tool, [PositionGoal(Vector3(*tip.position.tolist()), away)], start)
    directions = np.array([tool.model.forward(q).rotation[:, 2] for q in path.joints])
    steps = np.arccos(np.clip((directions[1:] * directions[:-1]).sum(axis=1), -1, 1))
    assert steps.max(initial=0.0) < 0.1
    assert path.reason or directions[-1] @ directions[0] == pytest.approx(-1, abs=1e-3)

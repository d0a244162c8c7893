"""Trajectories that somebody gives: completed, checked against the limits and the world, or refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ibrobot_planning.client import Client
from ibrobot_planning.execution.door import door_of
from ibrobot_planning.execution.requests import Execute, GoTo, MoveResult
from ibrobot_planning.execution.source import EXECUTE, GO_TO
from ibrobot_planning.goals.grammar import Target
from ibrobot_planning.planner import PlanRequest, PlanResult
from ibrobot_planning.planners.completion import MOST_POINTS, Start, completed
from ibrobot_planning.planners.timing import LONGEST_S
from ibrobot_planning.suite import FakePlanner

from ibrobot_core.api import (
    FollowTrajectory,
    HardwareError,
    Header,
    Joint,
    JointTrajectory,
    JointTrajectoryPoint,
    PlanCode,
    PlanningError,
    Robot,
    Vector,
    ns,
)
from ibrobot_core.app import Runtime, Spline

from .conftest import Make
from .table_arm import ARM
from .test_motion import assert_within_limits, command, finish, robot_yaml

WALL_BOX = {"shape": "box", "size": [0.3, 0.02, 0.3], "position": [0.2, 0, 0.15]}
LEFT, RIGHT = [1.0, 0.8, 0.8, 0.5, 0.0], [-1.0, 0.8, 0.8, 0.5, 0.0]
PERIOD_NS = ns(0.01)


@pytest.fixture
def run(start: Make, tmp_path: Path) -> Callable[..., Runtime]:
    def started(**asked: Any) -> Runtime:
        return start(text=robot_yaml(tmp_path) + "world: {}\n", **asked)

    return started


def at_up(run: Callable[..., Runtime]) -> Runtime:
    """A run with all joints at 0."""
    runtime = run()
    assert finish(runtime, runtime.session.bus.call(GO_TO, "up")).success
    return runtime


def at_left(run: Callable[..., Runtime]) -> Runtime:
    """A run with the arm on the left of a wall."""
    runtime = run()
    assert finish(runtime, runtime.session.bus.call(GO_TO, "left")).success
    runtime.session.bus.call("/world/add", {"name": "wall", "object": WALL_BOX})
    return runtime


def trajectory(*points: tuple[float, list[float]], fields: int = 1, names: tuple[str, ...] = ARM) -> JointTrajectory:
    """Points as (time [s], positions), at rest in each of them where `fields` gives velocities and accelerations."""
    rest = [np.zeros(len(names))] * (fields - 1)
    made = (JointTrajectoryPoint(ns(time), np.array(positions), *rest) for time, positions in points)
    return JointTrajectory(Header(), names, tuple(made))


def asked(wanted: Any) -> Any:
    """A request to follow a trajectory."""
    return Execute(wanted.joint_names, wanted.points) if isinstance(wanted, JointTrajectory) else wanted


def follow(runtime: Runtime, wanted: Any, commands: list[Vector] | None = None) -> MoveResult:
    return finish(runtime, runtime.session.bus.call(EXECUTE, asked(wanted)), commands)


@pytest.mark.parametrize("fields", [1, 2, 3], ids=["positions", "velocities", "accelerations"])
def test_trajectory_through_a_wall_is_refused_whatever_its_fields(run, fields: int):
    runtime = at_left(run)
    before = command(runtime)
    result = follow(runtime, trajectory((0, LEFT), (4, RIGHT), fields=fields))
    assert (result.outcome, result.code) == ("PLANNING_FAILED", PlanCode.INVALID_MOTION_PLAN)
    assert result.message.startswith("the trajectory is not free: ")
    assert "wall" in result.message
    np.testing.assert_array_equal(command(runtime), before)


@pytest.mark.parametrize("fields", [1, 2, 3], ids=["positions", "velocities", "accelerations"])
def test_wall_that_appears_stops_a_given_trajectory_whatever_its_fields(run, fields: int):
    runtime = run()
    assert finish(runtime, runtime.session.bus.call(GO_TO, "left")).success
    number = runtime.session.bus.call(EXECUTE, asked(trajectory((0, LEFT), (8, RIGHT), fields=fields)))
    for _ in range(20):
        runtime.step()
    runtime.session.bus.call("/world/add", {"name": "wall", "object": WALL_BOX})
    result = finish(runtime, number)
    assert result.code is PlanCode.MOTION_PLAN_INVALIDATED_BY_ENVIRONMENT_CHANGE
    assert command(runtime)[0] > 0.2, "it stands before the wall"


def through_service(runtime: Runtime, wanted: JointTrajectory) -> MoveResult:
    points = [{"time_from_start_ns": p.time_from_start_ns, "positions": p.positions.tolist()} for p in wanted.points]
    return follow(runtime, {"joint_names": list(wanted.joint_names), "points": points})


def through_target(runtime: Runtime, wanted: JointTrajectory) -> MoveResult:
    return finish(runtime, runtime.session.bus.call(GO_TO, GoTo(Target("trajectory", trajectory=wanted))))


def through_client(runtime: Runtime, wanted: JointTrajectory) -> MoveResult:
    return Client.of_run(runtime).follow(wanted).wait()


WAYS = [through_service, through_target, through_client]


@pytest.mark.parametrize("through", WAYS)
def test_jump_is_refused_for_every_caller(run, through: Callable[[Runtime, JointTrajectory], MoveResult]):
    runtime = at_up(run)
    before = command(runtime)
    result = through(runtime, trajectory((0, [0.0] * 5), (0.01, [1.5, 0, 0, 0, 0])))
    assert (result.success, result.code) == (False, PlanCode.INVALID_MOTION_PLAN)
    assert "its limit is 3 rad/s" in result.message
    np.testing.assert_array_equal(command(runtime), before)


@pytest.mark.parametrize("through", WAYS)
def test_wall_is_seen_for_every_caller(run, through: Callable[[Runtime, JointTrajectory], MoveResult]):
    runtime = at_left(run)
    result = through(runtime, trajectory((0, LEFT), (4, RIGHT)))
    assert (result.success, result.code) == (False, PlanCode.INVALID_MOTION_PLAN)
    assert "wall" in result.message


@pytest.mark.parametrize(
    ("points", "fields", "told"),
    [
        ([(0, 0), (0.2, 1.0)], 1, "a velocity of "),
        ([(0, 0), (0.45, 0.5)], 1, "acceleration of "),
        ([(0, 0), (0.45, 0.5)], 3, "acceleration of "),
        ([(0, 0), (2, 1.9), (3, 1.9), (5, 0)], 1, "outside its limits"),
        ([(0, 0), (4, 2.1), (8, 0)], 3, "outside its limits"),
        ([(0, 0)], 1, "at time 0, which leaves no time"),
        ([(1, 0), (0.5, 0)], 1, "not after the point before it"),
        ([(0, 0), (1, float("nan"))], 1, "must be a finite number"),
        ([(0, 0.02), (1, 0)], 1, "the trajectory begins with pan at 0.0200 rad, the robot is at "),
        ([(0, 0), (LONGEST_S + 1, 0.1)], 1, "at most 300 s are accepted"),
        ([(i, 0) for i in range(MOST_POINTS + 1)], 1, f"at most {MOST_POINTS} are accepted"),
    ],
)
def test_trajectory_beyond_a_limit_is_refused(run, points: list[tuple[float, float]], fields: int, told: str):
    runtime = at_up(run)
    before = command(runtime)
    result = follow(runtime, trajectory(*((t, [pan, 0, 0, 0, 0]) for t, pan in points), fields=fields))
    assert not result.success
    assert told in result.message
    np.testing.assert_array_equal(command(runtime), before)


@pytest.mark.parametrize("velocities", [[1.0, 0, 0, 0, 0], [0, 0, 0], [np.inf, 0, 0, 0, 0]])
def test_wrong_velocities_are_refused(run, velocities: list[float]):
    runtime = at_up(run)
    wanted = trajectory((0, [0.0] * 5), (1, [0.1, 0, 0, 0, 0]), fields=2)
    last = attrs.evolve(wanted.points[-1], velocities=np.array(velocities))
    assert follow(runtime, attrs.evolve(wanted, points=(wanted.points[0], last))).code is PlanCode.INVALID_MOTION_PLAN


def test_joint_named_twice_is_refused(run):
    runtime = run()
    with pytest.raises(PlanningError, match="no executor of mode plan follows trajectories of pan, pan"):
        runtime.session.bus.call(EXECUTE, asked(trajectory((0, [0.0] * 6), (1, [0.0] * 6), names=("pan", *ARM))))


def test_joint_named_twice_is_refused_for_every_executor():
    wanted = trajectory((0, [0.0, 0.0]), (1, [0.5, 0.5]), fields=3, names=("pan", "pan"))
    with pytest.raises(PlanningError, match="joint_names is pan, pan; it must have each joint once"):
        completed(wanted, Start(np.zeros(2)), ONE, PERIOD_NS)


@pytest.mark.parametrize("fields", [1, 2, 3], ids=["positions", "velocities", "accelerations"])
def test_given_trajectory_is_followed_within_the_limits(run, fields: int):
    runtime = at_up(run)
    commands = [command(runtime)]
    # The robot is 8 mrad away from the first point: a short motion leads there.
    wanted = trajectory((0, [0.008, 0, 0, 0, 0]), (1, [0.5, 0.3, 0, 0, 0]), (2, [0.9, 0, 0.2, 0, 0]), fields=fields)
    result = follow(runtime, wanted, commands)
    assert result.success, result.message
    np.testing.assert_allclose(command(runtime)[:5], wanted.points[-1].positions, atol=1e-9)
    assert_within_limits(runtime, commands)


ONE = Robot("one", (Joint("pan", -2.0, 2.0, max_velocity=3.0, max_acceleration=10.0),), groups={"arm": ("pan",)})


@settings(max_examples=200, deadline=None)
@given(
    gaps=st.lists(st.integers(10**6, 2 * 10**9), min_size=1, max_size=8),
    values=st.lists(st.floats(-2.2, 2.2), min_size=8, max_size=8),
    speeds=st.lists(st.floats(-3, 3), min_size=8, max_size=8),
    first=st.floats(-0.011, 0.011),
    fields=st.integers(1, 3),
    stand=st.booleans(),
)
def test_what_is_accepted_is_whole_and_within_the_limits(gaps, values, speeds, first, fields, stand):
    """Sampled by setpoints a period apart, at any phase; and it goes through the given points."""
    times = np.cumsum([0 if stand else 500_000_000, *gaps])
    positions = np.array([first, *values[: len(gaps)]])
    velocities = np.array([0.0 if stand else speeds[-1], *speeds[: len(gaps) - 1], 0.0])
    points = tuple(
        JointTrajectoryPoint(int(t), np.array([p]), *[np.array([v]), np.array([-v])][: fields - 1])
        for t, p, v in zip(times, positions, velocities, strict=True)
    )
    wanted = JointTrajectory(Header(), ("pan",), points)
    try:
        made = completed(wanted, Start(np.zeros(1)), ONE, PERIOD_NS)
    except PlanningError:
        return
    stamps = np.array([p.time_from_start_ns for p in made.points])
    columns = (np.array([getattr(p, n) for p in made.points]) for n in ("positions", "velocities", "accelerations"))
    spline = Spline(stamps, *columns)
    begins = stamps[0], made.points[0].positions[0], made.points[0].velocities[0], made.points[0].accelerations[0]
    assert np.abs(begins).max() <= 1e-9, "as the robot stands"
    for phase in (0, 3_100_000):
        ticks = range(-2 * PERIOD_NS + phase, spline.end_ns + 3 * PERIOD_NS, PERIOD_NS)
        setpoints = np.array([spline.at(tick)[0][0] for tick in ticks])
        assert np.abs(setpoints).max() <= 2.0 + 1e-4
        assert np.abs(np.diff(setpoints)).max() / 0.01 <= 3.0 * 1.02
        assert np.abs(np.diff(setpoints, 2)).max() / 0.01**2 <= 10.0 * 1.05
    later = int(stamps[-1]) - int(times[-1])
    assert later == 0 or stand
    for t, p in zip(times[1:], positions[1:], strict=True):
        assert spline.at(int(t) + later)[0][0] == pytest.approx(p, abs=1e-6)


@pytest.mark.parametrize("there", [0.05, 1.0], ids=["acceleration", "velocity"])
def test_jump_and_return_between_two_setpoints_is_refused(there: float):
    """Points a tenth of a control period apart: of all phases of the setpoints, some see the jump."""
    times = range(0, 5_000_000, 1_000_000)
    points = tuple(JointTrajectoryPoint(t, np.array([there if t == 3_000_000 else 0.0])) for t in times)
    with pytest.raises(PlanningError, match="pan near 0"):
        completed(JointTrajectory(Header(), ("pan",), points), Start(np.zeros(1)), ONE, PERIOD_NS)


@pytest.mark.parametrize("fields", [1, 3], ids=["positions", "accelerations"])
def test_jump_of_a_planner_of_another_plugin_is_refused(
    start: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fields: int
):
    def plan(self: FakePlanner, request: PlanRequest) -> PlanResult:
        end = request.start + np.array([0.5, 0, 0, 0, 0])
        points = (0, request.start.tolist()), (0.01, end.tolist())
        return PlanResult(trajectory(*points, fields=fields, names=request.joints))

    monkeypatch.setattr(FakePlanner, "plan", plan)
    runtime = start(text=robot_yaml(tmp_path).replace("type: rrt_connect", "type: cubic"))
    before = command(runtime)
    result = finish(runtime, runtime.session.bus.call(GO_TO, "left"))
    assert (result.outcome, result.code) == ("PLANNING_FAILED", PlanCode.INVALID_MOTION_PLAN)
    assert "its limit is 3 rad/s" in result.message
    np.testing.assert_array_equal(command(runtime), before)


def test_complete_trajectory_stays_as_it_is():
    wanted = trajectory((0, [0.0]), (1, [0.5]), fields=3, names=("pan",))
    assert completed(wanted, Start(np.zeros(1)), ONE, PERIOD_NS) is wanted


def test_nothing_is_proved_of_an_incomplete_trajectory(run):
    """A trajectory whose course is unknown is blocked, so that nothing runs unwatched."""
    touched = door_of(run().session).blocked(trajectory((0, LEFT), (1, LEFT)))
    assert "without velocities and accelerations" in touched


@pytest.mark.parametrize("by_control", [False, True])
def test_refused_trajectory_ends_no_motion_of_another_client(
    start: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, by_control: bool
):
    """The other motion begins with a pause, so that the robot is at rest."""
    text = robot_yaml(tmp_path).replace("{arm: [pan, lift", "{turn: [pan], arm: [lift")
    text = text.replace("executors:\n", "executors:\n  turn: {type: trajectory, group: turn}\n", 1)
    runtime = start(text=text.replace("[arm, gripper]", "[turn, arm, gripper]") + "world: {}\n")
    session, states = runtime.session, []
    runtime.step()
    session.on_goal.append(lambda event: states.append(event["state"]) if event["goal"] == "theirs" else None)
    pausing = trajectory((2, [0.0]), (4, [0.5]), names=("pan",))
    session.send_goal("turn", "theirs", FollowTrajectory(pausing))
    call = session.control.call

    def refused(command: Any) -> Any:
        if by_control and type(command).__name__ == "SendGoal":
            raise HardwareError("refused")
        return call(command)

    monkeypatch.setattr(session.control, "call", refused)
    if not by_control:
        session.bus.call("/world/add", {"name": "wall", "object": WALL_BOX})
    result = follow(runtime, trajectory((4, LEFT[1:]), names=ARM[1:]))
    assert result.code is (PlanCode.CONTROL_FAILED if by_control else PlanCode.INVALID_MOTION_PLAN)
    for _ in range(450):
        runtime.step()
    assert states == ["executing", "succeeded"]
    assert command(runtime)[0] == pytest.approx(0.5)

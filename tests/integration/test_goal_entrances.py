# mypy: disable-error-code="attr-defined,return-value"
"""Goals of trajectories, by every entrance: within the limits, clear of the world, or refused with a reason."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from typing import Any

import attrs
import goal_entrances
import numpy as np
import pytest
from goal_entrances import ARM, ARM_JOINTS, LEFT, Goal, Robot, tolerance
from ibrobot_ros2.calls import GoalRequest
from ibrobot_ros2.goals import TrajectoryCode

pytestmark = pytest.mark.integration
HERE = list(LEFT)
REST = [0.0] * 5


@pytest.fixture(scope="module")
def shared() -> Iterator[Robot]:
    with goal_entrances.robot() as made:
        goal_entrances.to_left(made)
        yield made


@pytest.fixture
def robot(shared: Robot) -> Iterator[Robot]:
    """A robot at rest beside a wall."""
    names = ",".join(f"{name}={value}" for name, value in zip(ARM_JOINTS, LEFT, strict=True))
    assert not shared.finish("service", shared.session.bus.call("/planning/go_to", names))
    shared.rest()
    shared.commands = [shared.command]
    return shared


def beside(pan: float = 0.0, **others: float) -> list[float]:
    """Positions beside those of the robot."""
    return [
        value + {"shoulder_pan": pan, **others}.get(name, 0.0) for name, value in zip(ARM_JOINTS, HERE, strict=True)
    ]


def goal(*points: dict[str, Any], **extras: Any) -> Goal:
    return Goal("", ARM_JOINTS, points, extras)


def point(time: float, positions: list[float], **fields: list[float]) -> dict[str, Any]:
    return {"time": time, "positions": positions, **fields}


def test_generated_goals_have_one_verdict():
    tally = goal_entrances.tried(60, seed=5)
    assert not tally.wrong, tally.wrong[0]
    assert tally.executed.total() >= 5


INVALID, OLD = TrajectoryCode.INVALID_GOAL, TrajectoryCode.OLD_HEADER_TIMESTAMP
NOT_A_NUMBER = float("nan")
REFUSED: dict[str, tuple[Goal, TrajectoryCode, str]] = {
    "through the wall": (goal(point(4, beside(-1.8))), INVALID, " wall"),
    "into the table": (
        goal(point(4, beside(shoulder_lift=1.4, elbow_flex=0.5))),
        INVALID,
        "the trajectory is not free",
    ),
    "1.5 rad in 10 ms": (goal(point(0.01, beside(-1.5))), INVALID, "its limit is 3 rad/s"),
    "waypoint beyond, path unchecked": (
        goal(point(3, beside(1.6)), point(6, HERE), path_tolerance=[tolerance("shoulder_pan", -1.0)]),
        INVALID,
        "outside its limits",
    ),
    "waypoint at 9 rad": (goal(point(20, beside(8.1)), point(40, HERE)), INVALID, "outside its limits"),
    "spline beyond": (
        goal(
            point(1, beside(0.9), velocities=[2.0, 0, 0, 0, 0]),
            point(2, beside(0.9), velocities=REST),
        ),
        INVALID,
        "outside its limits",
    ),
    "acceleration of 1e6 at the end": (
        goal(point(2, beside(0.1), velocities=REST, accelerations=[1e6, 0, 0, 0, 0])),
        INVALID,
        "point 0 of the trajectory gives shoulder_pan an acceleration of 1e+06 rad/s²; its limit is 40 rad/s²",
    ),
    "acceleration of 1e308": (
        goal(point(2, beside(0.1), velocities=REST, accelerations=[1e308, 0, 0, 0, 0])),
        INVALID,
        "among its accelerations; each must be a finite number, up to 1e+06",
    ),
    "path tolerance NaN": (
        goal(point(2, beside(0.1)), path_tolerance=[tolerance("elbow_flex", NOT_A_NUMBER)]),
        INVALID,
        "path_tolerance: elbow_flex: position is nan",
    ),
    "goal tolerance inf": (
        goal(point(2, beside(0.1)), goal_tolerance=[tolerance("elbow_flex", float("inf"))]),
        INVALID,
        "goal_tolerance: elbow_flex: position is inf",
    ),
    "tolerance of a velocity NaN": (
        goal(point(2, beside(0.1)), path_tolerance=[tolerance("elbow_flex", 0.0, velocity=NOT_A_NUMBER)]),
        INVALID,
        "velocity is nan",
    ),
    "goal time of a year": (goal(point(2, beside(0.1)), goal_time=3e7), INVALID, "goal_time is"),
    **{
        f"point at time 0 elsewhere, in {ahead_s} s": (
            goal(point(0, beside(0.5)), point(4, beside(0.1)), stamp=ahead_s),
            INVALID,
            "the trajectory begins with",
        )
        for ahead_s in (0.1, 0.6, 2.0, 60.0)
    },
    "an hour old": (goal(point(2, beside(0.1)), stamp=-3600.0), OLD, "it was to begin 3600.000 s ago"),
    "in an hour": (goal(point(2, beside(0.1)), stamp=3600.0), INVALID, "at most 300 s are accepted"),
    "unknown joint": (
        attrs.evolve(goal(point(2, beside(0.1))), names=("pan", *ARM_JOINTS[1:])),
        TrajectoryCode.INVALID_JOINTS,
        "joint_names must be",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_result_of_a_refused_goal_says_why(robot: Robot, case: str):
    asked, code, why = REFUSED[case]
    verdict, number = robot.by_ros(asked)
    assert not verdict.accepted
    assert why in verdict.message
    state, values = robot.ends[number]
    assert (state, values["error_code"]) == ("aborted", code)
    for _ in range(20):
        robot.step()
    np.testing.assert_array_equal(robot.commands, np.tile(robot.commands[0], (len(robot.commands), 1)))


ACCEPTED = {
    "one point": goal(point(1.5, beside(0.3))),
    "permuted": attrs.evolve(goal(point(1.5, beside(0.3)[::-1])), names=ARM_JOINTS[::-1]),
    "fast": goal(point(0.35, beside(0.45), velocities=REST)),
    "begins a moment ago": goal(point(0, HERE), point(1.5, beside(0.3)), stamp=-0.2),
    "begins in half a second": goal(point(1.5, beside(0.3)), stamp=0.5),
    "begins where it is in two seconds": goal(point(0, HERE), point(1.5, beside(0.3)), stamp=2.0),
    "unchecked path": goal(point(1.5, beside(0.3)), path_tolerance=[tolerance("shoulder_pan", -1.0)]),
}


@pytest.mark.parametrize("case", ACCEPTED)
def test_right_goals_are_followed(robot: Robot, case: str):
    asked = ACCEPTED[case]
    begun_ns = robot.session.clock.now_ns()
    verdict, number = robot.by_ros(asked)
    assert verdict.accepted, verdict
    assert robot.finish("ros", number) == ""
    end = dict(zip(asked.names, asked.points[-1]["positions"], strict=True))
    np.testing.assert_allclose(robot.command, [end[name] for name in ARM_JOINTS], atol=1e-6)
    took_s = (robot.session.clock.now_ns() - begun_ns) * 1e-9
    assert took_s == pytest.approx(asked.points[-1]["time"] + max(asked.extras.get("stamp", 0.0), 0.0), abs=0.4)


def within_limits(robot: Robot) -> None:
    commands = np.array(robot.commands)
    assert np.abs(np.diff(commands, axis=0)).max() * 100 <= 3.0 * 1.02
    assert np.abs(np.diff(commands, 2, axis=0)).max() * 1e4 <= 40.0 * 1.02


def test_next_goal_takes_over_from_the_one_under_way(robot: Robot):
    _, old = robot.by_ros(goal(point(2, beside(0.8))))
    for _ in range(60):
        robot.step()
    verdict, new = robot.by_ros(goal(point(1.5, beside(0.2))))
    assert verdict.accepted, verdict
    assert robot.finish("ros", new) == ""
    assert "replaced" in robot.ends[old][1]["error_string"]
    np.testing.assert_allclose(robot.command, beside(0.2), atol=1e-6)
    within_limits(robot)
    moved = np.abs(np.diff(np.array(robot.commands)[:, 0]))
    assert moved[55:75].min() > 1e-3, "it does not stop between"


def test_goal_is_checked_from_the_motion_under_way(robot: Robot):
    """A place that the arm is about to pass: to stand there at once takes more than the arm can brake."""
    _, old = robot.by_ros(goal(point(2, beside(0.8))))
    for _ in range(95):
        robot.step()
    before, now = robot.commands[-2:]
    verdict, _ = robot.by_ros(goal(point(0.03, (now + (now - before) * 5).tolist())))
    assert "acceleration of" in verdict.message, verdict
    assert robot.finish("ros", old) == ""


def test_wrong_goal_leaves_the_one_under_way(robot: Robot):
    _, old = robot.by_ros(goal(point(2, beside(0.8))))
    for _ in range(60):
        robot.step()
    for wrong in (goal(point(4, beside(-1.8))), goal(point(0.1, beside(-0.5)))):
        assert not robot.by_ros(wrong)[0].accepted
    assert robot.finish("ros", old) == ""
    np.testing.assert_allclose(robot.command, beside(0.8), atol=1e-6)
    within_limits(robot)


def test_goal_stops_before_what_comes_into_its_way(robot: Robot):
    verdict, number = robot.by_ros(goal(point(3, beside(0.9))))
    assert verdict.accepted
    for _ in range(30):
        robot.step()
    ahead = dict(zip(ARM_JOINTS, beside(0.7), strict=True))
    tip = robot.session.bus.call("/compute_fk", {"joints": ahead}).poses[0].pose.position
    box = {"shape": "box", "size": [0.05] * 3, "position": [tip.x, tip.y, tip.z]}
    robot.session.bus.call("/world/add", {"name": "box", "object": box})
    try:
        assert "box" in robot.finish("ros", number)
        robot.rest()
        within_limits(robot)
        assert robot.command[0] < HERE[0] + 0.8
    finally:
        robot.session.bus.call("/world/remove", "box")


def test_goal_older_than_a_stop_is_refused(robot: Robot):
    session = robot.session
    request = GoalRequest(90, goal(point(2, beside(0.1))).ros(0), ARM)
    stops = session.stops
    session.emergency_stop()
    robot.runtime.step()
    assert robot.actions.take_goal(robot, request, stops)
    assert "before a reset" in robot.ends[90][1]["error_string"]
    for _ in range(30):
        robot.runtime.step()
    robot.runtime.reset()
    assert robot.actions.take_goal(robot, attrs.evolve(request, number=91), stops)
    assert "a stop, a reset or another mode came after" in robot.ends[91][1]["error_string"]
    assert robot.by_ros(goal(point(2, beside(0.1))))[0].accepted
    robot.drop()


def test_flood_of_refused_goals_does_not_flood_the_log(robot: Robot, caplog: pytest.LogCaptureFixture):
    far = goal(point(4, beside(-1.8)))

    def lines(of: str) -> list[str]:
        messages = [record.getMessage() for record in caplog.records]
        return [each for each in messages if of in each and "not free" in each]

    for _ in range(1100):  # 11 s
        robot.step()
    with caplog.at_level(logging.INFO, logger="ibrobot"):
        for _ in range(150):
            robot.by_ros(far)
        assert len(lines("ros: ")) <= 3
        assert "such goals so far)" in lines("ros: ")[-1]
        for _ in range(100):
            robot.by_service(far)
        assert len(lines("goal trajectory failed")) == 1
        for _ in range(1100):
            robot.step()
        robot.by_service(far)
    assert "(and 99 more like it before)" in lines("goal trajectory failed")[-1]


@pytest.mark.parametrize(
    "command",
    [{"position": NOT_A_NUMBER}, {"position": 1e308}, {"max_effort": float("inf")}, {"max_effort": 1e308}],
    ids=str,
)
def test_goals_of_grippers_are_plausible(robot: Robot, command: dict[str, float]):
    fields = {"command": {"position": 0.5, "max_effort": 0.0, **command}}
    request = GoalRequest(95, fields, "gripper_action")
    assert not robot.actions.take_goal(robot, request, robot.session.stops), "their results have no place for a reason"


def test_goal_under_check_is_not_followed_after_a_fault_and_its_reset(robot: Robot, monkeypatch: pytest.MonkeyPatch):
    take = robot.session.goal_door
    assert take is not None

    def slowly(*arguments: Any) -> None:
        robot.session.raise_fault("a leader was lost")
        for _ in range(100):
            robot.runtime.step()
        robot.session.bus.call("/reset", {"stops": robot.session.stops})
        take(*arguments)

    monkeypatch.setattr(robot.session, "goal_door", slowly)
    verdict, _ = robot.by_ros(goal(point(2, beside(0.4))))
    before = robot.command.copy()
    for _ in range(300):
        robot.step()
    assert "a reset or another mode came after it" in verdict.message
    np.testing.assert_allclose(robot.command, before, atol=1e-3)

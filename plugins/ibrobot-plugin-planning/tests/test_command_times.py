# mypy: disable-error-code="arg-type,union-attr,attr-defined,unused-ignore"
"""Goals that carry a time obey the one rule of it, and motions end when the world gets too old."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import pytest
from ibrobot_planning.execution.requests import PlanAnswer
from ibrobot_planning.execution.services import PLAN_GOAL
from ibrobot_planning.execution.source import CMD_GOAL, CMD_POSE, EXECUTE, GO_TO, MOVE_TO_CONFIGURATION, RESULT

from ibrobot_core.api import (
    Header,
    JointTrajectory,
    Message,
    PlanCode,
    PlanningError,
    Pose,
    PoseStamped,
    Quaternion,
    String,
    Vector3,
    ns,
)
from ibrobot_core.app import Runtime

from .conftest import Make
from .table_arm import JOINTS
from .test_clouds import MOUNTS, cloud
from .test_motion import assert_within_limits, command, finish, robot_yaml
from .test_stale_world import FAR_POINTS, HOUR, YEAR

POSE = Pose(Vector3(0.2, 0.05, 0.1), Quaternion(1.0, 0.0, 0.0, 0.0))
OTHER_TIMES = {"an hour old": HOUR, "a year old": YEAR, "0.6 s old": 0.6, "an hour early": -HOUR, "0.6 s early": -0.6}
OFF = "the time in its header is more than 0.5 s off"
WORLD = """world:
  clouds: {lidar: {topic: /points, cell: 0.02, least_points: 1, reach: 2.0, furthest: 3.0}}
"""


@pytest.fixture
def run(start: Make, tmp_path: Path) -> Callable[..., Runtime]:
    def started(world: str = "", *, guarded: bool = True) -> Runtime:
        text = robot_yaml(tmp_path) + world
        runtime = start(text=text if guarded else text.replace("stop: hold", "stop: hold, guard: null"))
        runtime.session.clock.advance(ns(2 * YEAR))  # type: ignore[attr-defined]  # so that no stamp is below 0
        for _ in range(3):
            runtime.step()
        return runtime

    return started


def stamp(runtime: Runtime, age_s: float) -> int:
    return runtime.session.clock.now_ns() - ns(age_s)


def steps(runtime: Runtime, number: int = 60) -> float:
    """Step; return how far a joint has moved [rad]."""
    before = command(runtime)
    for _ in range(number):
        runtime.step()
    return float(np.abs(command(runtime) - before).max())


@pytest.mark.parametrize("age_s", OTHER_TIMES.values(), ids=OTHER_TIMES)
def test_pose_of_another_time_moves_nothing(run, age_s: float, caplog: pytest.LogCaptureFixture):
    runtime = run()
    runtime.session.bus.publish(CMD_POSE, PoseStamped(Header(stamp(runtime, age_s), "base"), POSE))
    assert steps(runtime) == 0
    assert f"/cmd_pose: INVALID_GOAL_CONSTRAINTS: {OFF}" in caplog.text


@pytest.mark.parametrize("age_s", [0.0, 0.4, -0.4, None], ids=["now", "0.4 s old", "0.4 s early", "no time"])
def test_pose_of_the_present_moves_the_arm(run, age_s: float | None):
    runtime = run()
    header = Header(0 if age_s is None else stamp(runtime, age_s))
    runtime.session.bus.publish(CMD_POSE, PoseStamped(header, POSE))
    assert steps(runtime) > 0.1


@pytest.mark.parametrize(
    "message",
    [POSE, PoseStamped(Header(0, "base"), POSE), String("pan=0.3")],
    ids=lambda message: type(message).__name__,
)
def test_goal_on_a_topic_that_waited_moves_nothing(run, message: Message):
    runtime = run()
    runtime.session.bus.publish(CMD_GOAL if isinstance(message, String) else CMD_POSE, message)
    runtime.session.clock.advance(ns(0.6))  # e.g. while another goal was planned
    assert steps(runtime) == 0


@pytest.mark.parametrize(("topic", "message"), [(CMD_POSE, POSE), (CMD_GOAL, String("pan=0.3"))])
def test_goal_on_a_topic_older_than_a_stop_moves_nothing(
    run, topic: str, message: Message, monkeypatch: pytest.MonkeyPatch
):
    """Also if it is read only after the reset has begun the mode."""
    runtime = run()
    source: Any = runtime.session.command_source
    runtime.session.bus.publish(topic, message)
    runtime.session.emergency_stop()
    assert steps(runtime, 2) == 0
    runtime.session.bus.publish(topic, message)
    with monkeypatch.context() as patch:
        patch.setattr(source, "_drain", lambda: None)
        runtime.reset()
    source._era = 0, 0
    assert steps(runtime) == 0
    runtime.session.bus.publish(topic, message)
    assert steps(runtime) > 0.1


@pytest.mark.parametrize("age_s", OTHER_TIMES.values(), ids=OTHER_TIMES)
def test_trajectory_and_joint_state_of_another_time_are_refused(run, age_s: float):
    runtime = run()
    bus = runtime.session.bus
    planned = bus.call(PLAN_GOAL, {"goal": "pan=0.3"})
    assert isinstance(planned, PlanAnswer)
    assert planned.trajectory is not None
    header = {"stamp_ns": stamp(runtime, age_s), "frame_id": ""}
    late = attrs.evolve(planned.trajectory, header=Header(**header))
    with pytest.raises(PlanningError, match=OFF):
        bus.call(EXECUTE, as_request(late))
    wanted = {"target_joint_state": {"name": ["pan"], "position": [0.3], "header": header}}
    runtime.session.request = attrs.evolve(runtime.session.request, lockstep=False)  # it refuses before it waits
    result = bus.call(MOVE_TO_CONFIGURATION, wanted)
    assert (result.outcome, OFF in result.message) == ("REJECTED", True)
    runtime.session.request = attrs.evolve(runtime.session.request, lockstep=True)
    assert steps(runtime) == 0


def as_request(trajectory: JointTrajectory) -> dict[str, Any]:
    return {
        "joint_names": list(trajectory.joint_names),
        "points": [
            {
                "positions": point.positions.tolist(),
                "velocities": point.velocities.tolist(),
                "accelerations": point.accelerations.tolist(),
                "time_from_start_ns": point.time_from_start_ns,
            }
            for point in trajectory.points
        ],
        "header": attrs.asdict(trajectory.header),
    }


def test_plan_may_be_executed_later(run):
    runtime = run()
    planned = runtime.session.bus.call(PLAN_GOAL, {"goal": "pan=0.3"})
    steps(runtime, 100)
    assert finish(runtime, runtime.session.bus.call(EXECUTE, as_request(planned.trajectory))).success


# The world under a motion.


def see(runtime: Runtime) -> None:
    points = cloud(FAR_POINTS)
    runtime.session.bus.publish("/points", attrs.evolve(points, header=Header(stamp(runtime, 0), "lidar")))


def seeing(run: Callable[..., Runtime], world: str = WORLD) -> Runtime:
    runtime = run(world)
    runtime.session.bus.publish("/tf_static", MOUNTS, latched=True)
    see(runtime)
    runtime.step()
    return runtime


def test_motion_stops_when_the_world_gets_too_old(run):
    # Without the guard, which would brake harder than along the path.
    runtime = seeing(lambda world: run(world, guarded=False))
    number = runtime.session.bus.call(GO_TO, {"goal": "left"})
    commands = []
    for tick in range(170):
        if tick % 10 == 0 and tick < 20:
            see(runtime)
        runtime.step()
        commands.append(command(runtime))
    slow = runtime.session.bus.call(GO_TO, {"goal": "right"})
    refused = finish(runtime, slow)
    assert runtime.session.bus.call(RESULT, number).success, "it ended before"
    assert (refused.outcome, refused.code.name) == ("PLANNING_FAILED", "SENSOR_INFO_STALE")
    see(runtime)
    runtime.step()
    number = runtime.session.bus.call(GO_TO, {"goal": "right"})
    runtime.session.clock.advance(ns(1.2))
    result = finish(runtime, number, commands)
    assert (result.outcome, result.code.name) == ("EXECUTION_FAILED", "SENSOR_INFO_STALE")
    assert "stopped: the motion cannot be checked: the world is not known well enough" in result.message
    assert "cloud 'lidar' (/points) is 1.5 s old, at most 1.5 s is allowed" in result.message
    assert_within_limits(runtime, commands)
    at = command(runtime)
    assert np.abs(at - runtime.session.config.robot.pose("right")).max() > 0.1, "it stopped on the way"
    assert steps(runtime) == 0


@pytest.mark.parametrize("rule", ["keep", "forget"])
def test_motion_goes_on_where_the_rule_says_so(run, rule: str):
    runtime = seeing(run, WORLD.replace("cell:", f"when_stale: {rule}, cell:"))
    number = runtime.session.bus.call(GO_TO, {"goal": "left"})
    runtime.session.clock.advance(ns(1.2))
    assert finish(runtime, number).success


def test_goals_of_the_start_wait_for_the_first_cloud(start: Make, tmp_path: Path):
    runtime = start(text=robot_yaml(tmp_path) + WORLD, goals=("pan=0.3",))
    runtime.session.bus.publish("/tf_static", MOUNTS, latched=True)
    assert steps(runtime, 100) == 0, "a second without a cloud"
    see(runtime)
    for tick in range(400):
        if tick % 20 == 0:
            see(runtime)
        if runtime.step():
            break
    assert abs(command(runtime)[JOINTS.index("pan")] - 0.3) < 1e-3


def test_goals_of_the_start_do_not_wait_for_ever(start: Make, tmp_path: Path):
    runtime = start(text=robot_yaml(tmp_path) + WORLD, goals=("pan=0.3",))
    for _ in range(520):
        if runtime.step():
            break
    ((_, result),) = runtime.session.command_source._ended()  # type: ignore[attr-defined]
    assert result.code is PlanCode.SENSOR_INFO_STALE
    assert "nothing usable has come for 5.0 s" in result.message

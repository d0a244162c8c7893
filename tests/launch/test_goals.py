"""Goals of executors go to control by one door; without a plugin that checks them, the run says so."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from ibrobot_core.api import FollowTrajectory, HardwareError, Header, JointTrajectory, JointTrajectoryPoint

if TYPE_CHECKING:
    from fake_runs import Runs

GOAL = FollowTrajectory(JointTrajectory(Header(), ("pan",), (JointTrajectoryPoint(10**9, np.array([0.1])),)))


@pytest.fixture
def runtime(runs: Runs) -> Any:
    return runs.start("control_modes.goals={executors: [arm_trajectory]}", mode="goals")


def test_unchecked_goals_are_mentioned_once(runs: Runs, caplog: pytest.LogCaptureFixture):
    runtime = runs.start("control_modes.goals={executors: [arm_trajectory]}", mode="goals")
    assert caplog.text.count("goals of trajectories are limited, not checked: no plugin checks them") == 1
    runtime.session.send_goal("arm_trajectory", "one", GOAL)
    for _ in range(5):
        runtime.step()
    assert caplog.text.count("not checked") == 1


def test_goals_pass_the_door(runtime: Any):
    session, seen = runtime.session, []

    def door(executor: str, goal_id: str, goal: Any, send: Any) -> None:
        seen.append((executor, goal_id))
        send(goal)

    session.goal_door = door
    events: list[Any] = []
    session.on_goal.append(events.append)
    session.send_goal("arm_trajectory", "one", GOAL)
    assert seen == [("arm_trajectory", "one")]
    for _ in range(3):
        runtime.step()
    assert events[0]["goal"] == "one"


def test_goals_are_refused_before_a_reset(runtime: Any):
    runtime.session.emergency_stop()
    runtime.step()
    with pytest.raises(HardwareError, match="refused before a reset"):
        runtime.session.send_goal("arm_trajectory", "one", GOAL)


def test_goal_older_than_a_stop_is_refused(runtime: Any):
    session = runtime.session
    stops = session.stops
    session.emergency_stop()
    for _ in range(50):
        runtime.step()
    runtime.reset()
    with pytest.raises(HardwareError, match="a stop, a reset or another mode came after it was requested"):
        session.send_goal("arm_trajectory", "one", GOAL, stops)
    session.send_goal("arm_trajectory", "two", GOAL, session.stops)

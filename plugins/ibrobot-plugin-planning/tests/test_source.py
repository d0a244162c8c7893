"""The command source of modes with a planner: goals, one after the other."""

from __future__ import annotations

from typing import Any

import pytest
from ibrobot_planning.execution.source import GO_TO

from ibrobot_core.api import PlanningError, TransportError
from ibrobot_core.app import Runtime

from .conftest import Make


def seconds(runtime: Runtime, duration: float) -> None:
    for _ in range(round(duration * runtime.session.config.control.rate_hz)):
        runtime.step()


def to_the_end(runtime: Runtime) -> None:
    for _ in range(3000):
        if runtime.step():
            return
    raise AssertionError("the run does not end")


def position(runtime: Runtime) -> list[float]:
    assert runtime.session.state is not None
    return runtime.session.state.position.tolist()


def test_service_takes_goals(start: Make):
    runtime = start(mode="idle")
    pan, grip = position(runtime)
    runtime.switch_mode("plan")
    seconds(runtime, 1.0)
    assert position(runtime)[0] == pytest.approx(pan, abs=0.05), "it holds where it was"
    runtime.session.bus.call(GO_TO, "up")
    seconds(runtime, 2.0)
    assert position(runtime)[0] == pytest.approx(0.4, abs=0.02)
    assert position(runtime)[1] == pytest.approx(grip, abs=0.05), "no executor of this mode owns it"


def test_planning_mode_takes_over_the_services_of_another(start: Make):
    runtime = start(mode="plan")
    runtime.switch_mode("foreign")
    runtime.session.bus.call(GO_TO, "pan=0.2")
    seconds(runtime, 2.0)
    assert position(runtime)[0] == pytest.approx(0.2, abs=0.02)
    runtime.switch_mode("idle")
    with pytest.raises(TransportError, match="nobody serves /planning/go_to"):
        runtime.session.bus.call(GO_TO, "up")


@pytest.mark.parametrize("mode", ["all", "foreign"], ids=["own executors", "executor and planner of another plugin"])
def test_goals_one_after_the_other_end_the_run(start: Make, mode: str):
    runtime = start(mode=mode, goals=("up", "pan=-0.3"))
    to_the_end(runtime)
    assert position(runtime)[0] == pytest.approx(-0.3, abs=0.03)
    assert runtime.summary()["goals_failed"] == 0


def test_executor_of_positions_gets_its_joint(start: Make):
    runtime = start(mode="all", goals=("pan=0.1,grip=0.4",))
    to_the_end(runtime)
    assert position(runtime) == pytest.approx([0.1, 0.4], abs=0.03)


def test_goals_of_the_request_count_once(start: Make):
    runtime = start(mode="plan", goals=("up", "home"))
    runtime.switch_mode("idle")
    runtime.switch_mode("plan")
    seconds(runtime, 3.0)
    assert not runtime.session.finished.is_set()
    assert position(runtime)[0] == pytest.approx(0.0, abs=0.1)


@pytest.mark.parametrize(
    ("goal", "code"),
    [("pan=5", "INVALID_GOAL_CONSTRAINTS"), ("grip=0.1", "PLANNING_FAILED")],
    ids=["outside limits", "no executor"],
)
def test_goal_that_cannot_be_reached_is_counted_and_the_next_one_tried(
    start: Make, goal: str, code: str, caplog: pytest.LogCaptureFixture
):
    runtime = start(mode="plan", goals=(goal, "up"))
    to_the_end(runtime)
    summary = runtime.summary()
    assert summary["goals_failed"] == 1
    assert [(each["goal"], each["code"]) for each in summary["goals"]] == [(goal, code), ("up", "SUCCESS")]
    assert f"goal {goal} failed: {code}: " in caplog.text
    rows = runtime.plan.mode.source.summary_rows()
    assert rows[0] == ("goals", "1 of 2 reached")
    assert rows[1][1].startswith(f"{goal}: {code}: ")
    assert position(runtime)[0] == pytest.approx(0.4, abs=0.03)


def test_emergency_stop_fails_the_goal_under_way(start: Make):
    runtime = start(mode="plan", goals=("up",))
    seconds(runtime, 0.1)
    runtime.session.emergency_stop()
    to_the_end(runtime)
    assert runtime.summary()["goals_failed"] == 1


def test_goals_requested_before_an_emergency_stop_do_not_begin_after_the_reset(start: Make):
    runtime = start(mode="plan", goals=("up", "pan=-0.3"))
    seconds(runtime, 0.1)
    runtime.session.emergency_stop()
    clock: Any = runtime.session.clock
    control: Any = runtime.session.control
    for _ in range(30):  # it brakes, and the source has no time to notice
        clock.advance(20_000_000)
        control.step()
    runtime.reset()
    seconds(runtime, 0.1)
    resting = position(runtime)
    seconds(runtime, 2.0)

    assert position(runtime) == pytest.approx(resting, abs=1e-3)
    assert runtime.summary()["goals_failed"] == 2


def test_goal_sent_while_the_robot_is_stopped_is_refused(start: Make):
    runtime = start(mode="plan")
    runtime.session.emergency_stop()
    seconds(runtime, 0.1)
    with pytest.raises(PlanningError, match="refused before a reset: emergency stop"):
        runtime.session.bus.call(GO_TO, "up")
    runtime.reset()
    resting = position(runtime)
    seconds(runtime, 1.0)
    assert position(runtime) == pytest.approx(resting, abs=1e-3)
    runtime.session.bus.call(GO_TO, "up")
    seconds(runtime, 2.0)
    assert position(runtime)[0] == pytest.approx(0.4, abs=0.03)


def test_status_of_an_earlier_goal_does_not_end_the_present_one(start: Make):
    runtime = start(mode="plan", goals=("up",))
    seconds(runtime, 0.1)
    event = {"executor": "arm_trajectory", "goal": "0:arm_trajectory", "state": "canceled", "message": "", "result": {}}
    for call in runtime.session.on_goal:
        call(event)
    to_the_end(runtime)
    assert runtime.summary()["goals_failed"] == 0
    assert position(runtime)[0] == pytest.approx(0.4, abs=0.03)


def test_reset_fails_the_goal_under_way_and_the_next_is_tried(start: Make):
    runtime = start(mode="plan", goals=("up", "pan=-0.3"))
    seconds(runtime, 0.1)
    runtime.reset()
    to_the_end(runtime)
    assert runtime.summary()["goals_failed"] == 1
    assert position(runtime)[0] == pytest.approx(-0.3, abs=0.03)


@pytest.mark.parametrize(
    ("goal", "message"),
    [
        (
            "hom",
            "goal 'hom': no pose 'hom'; the poses are: home, up;"
            " or give joints, e.g. wrist_flex=0.5, or a position, e.g. xyz=0.2,0.0,0.1",
        ),
        ("tilt=1", "goal 'tilt=1': no joint 'tilt'; the joints are: pan, grip"),
        ("pan=1,grip=wide", "goal 'pan=1,grip=wide': 'wide' is not an angle in radians"),
        ("pan=nan", "goal 'pan=nan': 'nan' is not an angle in radians"),
    ],
)
def test_goal_that_makes_no_sense_is_refused_before_anything_starts(make: Make, goal: str, message: str):
    with pytest.raises(PlanningError) as failure:
        make(mode="plan", goals=(goal,))
    assert str(failure.value) == message
    assert failure.value.exit_code == 2

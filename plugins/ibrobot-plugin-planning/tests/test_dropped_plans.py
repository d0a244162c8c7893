"""Searches that nobody wants any more: cancelled, replaced, or in the way of a motion."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest
from ibrobot_planning.execution.requests import MoveResult
from ibrobot_planning.execution.source import CANCEL, GO_TO, RESULT, PlannerSource
from ibrobot_planning.planner import AnyGoal, Goal, JointGoal, LinearGoal, PlanRequest, PlanResult, PositionGoal

from ibrobot_core.api import PlanCode, PlanningError, Vector3
from ibrobot_core.app import Runtime

from .conftest import Make
from .table_arm import ARM, WALL, make_planner

LEFT, RIGHT = np.array([1.0, 0.8, 0.8, 0.5, 0.0]), np.array([-1.0, 0.8, 0.8, 0.5, 0.0])


class Patience:
    """Wants a plan for some checks only."""

    def __init__(self, checks: int) -> None:
        self.left = checks
        self.after = 0

    def __call__(self) -> None:
        self.left -= 1
        if self.left < 0:
            self.after += 1
            raise PlanningError("cancelled", PlanCode.PREEMPTED)


GOALS: Mapping[str, Goal] = {
    "joints": JointGoal(ARM, RIGHT),
    "alternatives": AnyGoal((PositionGoal(Vector3(9, 9, 9)), JointGoal(ARM, RIGHT), JointGoal(ARM, -RIGHT))),
    "position": PositionGoal(Vector3(0.25, -0.2, 0.15)),
    "line": LinearGoal((PositionGoal(Vector3(0.25, 0.15, 0.2)),), 0.1),
}


@pytest.mark.parametrize("goal", GOALS)
def test_search_ends_at_each_moment_at_which_it_is_not_wanted(tmp_path, goal: str):
    planner = make_planner(tmp_path, WALL)
    asked = 0

    def count() -> None:
        nonlocal asked
        asked += 1

    planner.plan(PlanRequest(ARM, LEFT.copy(), GOALS[goal], check_wanted=count))
    assert asked > 3
    for checks in {0, 1, 2, asked // 3, asked // 2, asked - 1}:
        patience = Patience(checks)
        with pytest.raises(PlanningError, match=r"^cancelled$") as caught:
            planner.plan(PlanRequest(ARM, LEFT.copy(), GOALS[goal], check_wanted=patience))
        assert caught.value.code is PlanCode.PREEMPTED
        assert patience.after == 1, "it ends at once"


class Endless:
    """Lets the plans of a run go on until nobody wants them."""

    def __init__(self, runtime: Runtime, monkeypatch: pytest.MonkeyPatch) -> None:
        source = runtime.session.command_source
        assert isinstance(source, PlannerSource)
        self.plans = source._plans
        self._plan = self.plans.planner.plan
        self.begun = threading.Semaphore(0)
        self.endless = True
        monkeypatch.setattr(self.plans.planner, "plan", self.plan)

    def plan(self, request: PlanRequest) -> PlanResult:
        self.begun.release()
        while self.endless:
            request.check_wanted()
        return self._plan(request)


class Beside:
    """A call in a thread of its own."""

    def __init__(self, call: Callable[[], Any]) -> None:
        self.answer: Any = None
        self._call = call
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        self.answer = self._call()

    def join(self) -> Any:
        self._thread.join()
        return self.answer


def result_of(runtime: Runtime, number: int) -> MoveResult:
    """The result of a goal that has ended."""
    result = runtime.session.bus.call(RESULT, number)
    assert result is not None
    return result


def steps(runtime: Runtime, ticks: int = 5) -> None:
    """Let time pass; a search begins within it."""
    for _ in range(ticks):
        runtime.step()


@pytest.fixture
def runtime(start: Make) -> Runtime:
    runtime: Runtime = start(mode="plan")
    steps(runtime)
    return runtime


def test_cancel_ends_the_search_for_a_goal(runtime: Runtime, monkeypatch: pytest.MonkeyPatch):
    endless, bus = Endless(runtime, monkeypatch), runtime.session.bus
    number = bus.call(GO_TO, "up")
    stepping = Beside(lambda: steps(runtime))
    endless.begun.acquire()
    bus.call(CANCEL)
    stepping.join()
    result = result_of(runtime, number)
    assert (result.outcome, result.code, result.message) == ("CANCELLED", PlanCode.PREEMPTED, "cancelled")


def test_cancel_that_comes_before_the_search_ends_it_too(runtime: Runtime, monkeypatch: pytest.MonkeyPatch):
    endless, bus = Endless(runtime, monkeypatch), runtime.session.bus
    source = runtime.session.command_source
    begin = source._begin  # type: ignore[attr-defined]

    def cancelled_before(move: Any) -> None:
        bus.call(CANCEL)
        begin(move)

    monkeypatch.setattr(source, "_begin", cancelled_before)
    number = bus.call(GO_TO, "up")
    steps(runtime)
    assert result_of(runtime, number).outcome == "CANCELLED"
    assert not endless.begun.acquire(blocking=False), "it has not even begun"


def test_goal_that_replaces_another_ends_its_search(runtime: Runtime, monkeypatch: pytest.MonkeyPatch):
    endless, bus = Endless(runtime, monkeypatch), runtime.session.bus
    first = bus.call(GO_TO, "up")
    stepping = Beside(lambda: steps(runtime))
    endless.begun.acquire()
    endless.endless = False  # for the next one; this one is asked once more
    second = bus.call(GO_TO, "pan=-0.3")
    stepping.join()
    steps(runtime, 200)
    assert result_of(runtime, first).outcome == "CANCELLED"
    assert result_of(runtime, second).outcome == "SUCCEEDED"


def test_motion_comes_before_plans_that_move_nothing(runtime: Runtime, monkeypatch: pytest.MonkeyPatch):
    endless, bus = Endless(runtime, monkeypatch), runtime.session.bus
    previews = [Beside(lambda: bus.call("/planning/plan", "up")) for _ in range(3)]
    endless.begun.acquire()
    number = bus.call(GO_TO, "up")
    stepping = Beside(lambda: steps(runtime))
    answers = [each.join() for each in previews]
    assert {(each.code, each.message) for each in answers} <= {
        (PlanCode.PREEMPTED, "the planner plans a motion instead: ask again"),
        (PlanCode.PREEMPTED, "cancelled"),  # the goal replaces all that was wanted before
    }
    endless.endless = False
    stepping.join()
    steps(runtime, 200)
    assert result_of(runtime, number).outcome == "SUCCEEDED"


def test_plan_that_moves_nothing_does_not_wait_for_that_of_a_motion(runtime: Runtime, monkeypatch: pytest.MonkeyPatch):
    endless, bus = Endless(runtime, monkeypatch), runtime.session.bus
    bus.call(GO_TO, "up")
    stepping = Beside(lambda: steps(runtime))
    endless.begun.acquire()
    answer = bus.call("/planning/plan", "up")
    assert (answer.code, answer.message) == (PlanCode.PREEMPTED, "the planner plans a motion instead: ask again")
    bus.call(CANCEL)
    stepping.join()


def test_cancel_ends_plans_that_move_nothing(runtime: Runtime, monkeypatch: pytest.MonkeyPatch):
    endless, bus = Endless(runtime, monkeypatch), runtime.session.bus
    previews = [Beside(lambda: bus.call("/planning/plan", "up")) for _ in range(3)]
    endless.begun.acquire()
    while any(each._thread.is_alive() for each in previews):  # those that were asked for later are of another era
        bus.call(CANCEL)
    assert {each.join().code for each in previews} == {PlanCode.PREEMPTED}

"""Robots leave a server that fails or is slow where others serve, and its health says so."""

from __future__ import annotations

import itertools
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

import attrs
import numpy as np
import pytest
from ibrobot_serve import fleet as fleet_module
from ibrobot_serve import pacing, remote, service
from ibrobot_serve.fleet import Choice, Offer, good, ranked
from ibrobot_serve.metrics import probes
from ibrobot_serve.results import Results

from ibrobot_core.api import PolicyError, Tensors

from .served_fleet import Fault, Fleet, Robot

S = 1_000_000_000
ROUNDS, PERIOD_S = 24, 0.8


class Clock:
    """Stands in for `time`; only `wait` moves it."""

    def __init__(self) -> None:
        self.now_ns = time.monotonic_ns()

    def monotonic_ns(self) -> int:
        return self.now_ns

    time_ns = monotonic_ns

    def monotonic(self) -> float:
        return self.now_ns / S

    def wait(self, seconds: float) -> None:
        self.now_ns += round(seconds * S)


@pytest.fixture
def clock(fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    for module in (remote, service):
        monkeypatch.setattr(module, "time", made)
    monkeypatch.setattr(fleet_module, "SETTLED_S", 0.0)
    monkeypatch.setattr(pacing, "_WINDOW_NS", 5 * S)
    return made


def raises(tensors: Tensors) -> Tensors:
    raise ValueError("CUDA error: device-side assert triggered")


def half() -> Fault:
    """Raises at every second request."""
    count = itertools.count()
    return lambda tensors: raises(tensors) if next(count) % 2 else {}


def after(requests: int, fault: Fault) -> Fault:
    """Begins after a number of requests."""
    count = itertools.count()
    return lambda tensors: fault(tensors) if next(count) >= requests else {}


def slow(clock: Clock, seconds: float, fault: Fault = lambda tensors: {}) -> Fault:
    """Takes long, then does what `fault` does."""

    def work(tensors: Tensors) -> Tensors:
        clock.wait(seconds)
        return fault(tensors)

    return work


FAULTS: dict[str, Callable[[Clock], Fault]] = {
    "raises": lambda clock: raises,
    "raises after a while": lambda clock: after(20, raises),
    "raises at every second request": lambda clock: half(),
    "NaN": lambda clock: lambda tensors: {"twice": np.array([np.nan])},
    "infinity after a while": lambda clock: after(9, lambda tensors: {"twice": np.array([np.inf])}),
    "no array": lambda clock: lambda tensors: {"twice": np.array([object()])},
    "slow": lambda clock: slow(clock, 0.5),
    "slow after a while": lambda clock: after(20, slow(clock, 0.5)),
    "slow, then raises": lambda clock: slow(clock, 0.5, raises),
    "raises after the deadline": lambda clock: slow(clock, 2.5, raises),
}


def drive(robots: list[Robot], clock: Clock, *, episodes: bool) -> tuple[list[list[int]], dict[str, int]]:
    """Let the robots ask in turns.

    Returns:
        The servers of each robot's last ten answers; each robot's largest number of failures in a row.
    """
    answers: list[list[int]] = [[] for _ in robots]
    worst: dict[str, int] = {}
    row = Counter[str]()
    for number in range(ROUNDS):
        for index, robot in enumerate(robots):
            if episodes and number % 8 == 7:
                robot.engine.reset(number)
            name = robot.engine._robot
            try:
                answers[index].append(asked(robot, number, clock))
                row[name] = 0
            except PolicyError:
                row[name] += 1
            worst[name] = max(worst.get(name, 0), row[name])
            clock.wait(PERIOD_S / len(robots))
    return [each[-10:] for each in answers], worst


def asked(robot: Robot, x: int, clock: Clock, timeout_s: float = 2.0) -> int:
    """The server that answered rightly."""
    outputs = robot.engine.infer({"x": np.array([x])}, x, clock.monotonic_ns() + round(timeout_s * S))
    assert outputs["twice"].tolist() == [2 * x]
    return int(outputs["server"][0])


@pytest.mark.parametrize("episodes", [False, True], ids=["one episode", "many episodes"])
@pytest.mark.parametrize("canary", [0.0, 0.3], ids=["server", "canary"])
@pytest.mark.parametrize("fault", FAULTS)
def test_fleet_leaves_a_server_that_is_worse_than_the_others(
    fleet: Fleet, clock: Clock, fault: str, canary: float, episodes: bool
) -> None:
    bad = fleet.server("new" if canary else "old", canary=canary, fault=FAULTS[fault](clock))
    for _ in range(2):
        fleet.server("old", fault=slow(clock, 0.02))
    last, worst = drive(fleet.robots(12), clock, episodes=episodes)
    assert max(worst.values()) <= 2
    at_bad = sum(each.count(0) for each in last)
    assert at_bad == 0 or (not canary and episodes and at_bad < 20), "robots may try an ordinary server again"
    assert fleet.policies[0].entered._value > 0, "no robot was at the bad server"
    assert bad.statistics()["requests"] > 0


def test_fleet_with_a_failing_server_a_slow_one_and_a_failing_canary(fleet: Fleet, clock: Clock) -> None:
    fleet.server("old", fault=raises)
    fleet.server("old", fault=slow(clock, 0.5))
    fleet.server("old", fault=slow(clock, 0.02))
    fleet.server("new", canary=0.3, fault=raises)
    last, worst = drive(fleet.robots(12), clock, episodes=False)
    assert max(worst.values()) <= 2
    assert {server for each in last for server in each} == {2}


def test_fleet_of_which_only_one_server_works(fleet: Fleet, clock: Clock) -> None:
    for _ in range(3):
        fleet.server(fault=raises)
    fleet.server()
    last, worst = drive(fleet.robots(12), clock, episodes=False)
    assert max(worst.values()) == 0, "another server answered the same request"
    assert {server for each in last for server in each} == {3}


def test_request_that_fails_everywhere_moves_nobody(
    fleet: Fleet, clock: Clock, caplog: pytest.LogCaptureFixture
) -> None:
    def wrong(tensors: Tensors) -> Tensors:
        return raises(tensors) if tensors["x"][0] == 7 else {}

    for _ in range(3):
        fleet.server(fault=wrong)
    robots = fleet.robots(6)
    first = [robot.ask() for robot in robots]
    for _ in range(4):
        with pytest.raises(PolicyError, match="device-side assert"):
            asked(robots[0], 7, clock)
        assert [robot.ask() for robot in robots[1:]] == first[1:]
    assert asked(robots[0], 1, clock) == first[0]
    assert {each.state for each in fleet.servers} == {"ready"}, "the other robots are answered"
    assert "failed" not in caplog.text.replace("the policy failed", "")


def test_failing_server_says_so_until_it_answers(fleet: Fleet, clock: Clock) -> None:
    failing = fleet.server(fault=raises)
    asks = probes(failing)
    robot = fleet.robot()
    for number in range(3):
        assert (failing.state, asks.unhealthy(), asks.unready()) == ("ready", "", "")
        with pytest.raises(PolicyError):
            asked(robot, number, clock)
    said = "the model fails all requests: ValueError: CUDA error: device-side assert triggered"
    assert (failing.state, asks.unhealthy(), asks.unready()) == ("fails", said, said)
    assert failing.statistics()["error"] == "ValueError: CUDA error: device-side assert triggered"
    clock.wait(3600.0)
    assert failing.state == "fails", "silence is no answer"
    fleet.policies[0].fault = lambda tensors: {}
    assert asked(robot, 9, clock) == 0
    assert (failing.state, asks.unhealthy(), asks.unready()) == ("ready", "", "")


def test_server_that_works_again_gets_robots_again(fleet: Fleet, clock: Clock) -> None:
    fleet.server(fault=raises)
    fleet.server()
    robots = fleet.robots(6)
    drive(robots, clock, episodes=True)
    fleet.policies[0].fault = lambda tensors: {}
    for number in range(30):
        for robot in robots:
            robot.engine.reset(number)
            asked(robot, number, clock)
        clock.wait(5.0)
    assert Counter(asked(robot, 1, clock) for robot in robots) == {0: 3, 1: 3}


def test_robot_that_has_left_a_canary_uses_it_when_nothing_else_is_left(fleet: Fleet, clock: Clock) -> None:
    fleet.server("old", fault=slow(clock, 0.02))
    fleet.server("new", canary=0.5, fault=after(1, slow(clock, 0.5)))
    robots = fleet.robots(12)
    last, _ = drive(robots, clock, episodes=False)
    assert {server for each in last for server in each} == {0}
    trying = [robot for robot in robots if robot.engine._left]
    assert trying
    fleet.kill(0)
    assert {asked(robot, 1, clock) for robot in trying} == {1}


def test_policy_that_remembers_fails_once_before_it_moves(fleet: Fleet, clock: Clock) -> None:
    fleet.server(stateful=True, fault=raises)
    fleet.server(stateful=True)
    robot = fleet.robot("first", stateful=True)
    robot.engine._session = next(o for o in offers_of(robot) if o.server == fleet.servers[0].id)
    with pytest.raises(PolicyError, match="device-side assert"):
        asked(robot, 1, clock)
    assert [asked(robot, 2, clock), asked(robot, 3, clock)] == [1, 1]


def offers_of(robot: Robot) -> list[Offer]:
    return robot.engine._offers(robot.engine._transport.served("infer/net/offer/"))


def offers(*latencies_ms: float, **changes: Any) -> list[Offer]:
    made = [Offer(f"s{i}", "f", "", {}, 0, 0.0, 9.0, latency_ms=each) for i, each in enumerate(latencies_ms)]
    return [attrs.evolve(each, **changes) for each in made]


@pytest.mark.parametrize(
    ("latencies_ms", "left"),
    [
        ((20, 20, 500), {2}),
        ((20, 500, 500), {1, 2}),
        ((20, 500), {1}),
        ((20, 60), set()),
        ((200, 250, 500), set()),
        ((200, 250, 800), {2}),
        ((0, 0, 500), set()),
        ((0, 20, 500), {2}),
        ((500, 500, 500), set()),
    ],
)
def test_slow_servers(latencies_ms: tuple[float, ...], left: set[int]) -> None:
    made = offers(*latencies_ms)
    assert good(made) == [each for i, each in enumerate(made) if i not in left]
    slow_ones = {f"s{i}" for i in left}
    assert {each.server for each in ranked(made, "robot")[len(made) - len(left) :]} == slow_ones


def test_pauses_of_a_server_that_fails_again_double_up_to_a_minute() -> None:
    choice, now_s = Choice("robot"), 0.0
    for pause_s in (5, 10, 20, 40, 60, 60):
        choice.avoid("s0", now_s)
        for at_s, first in ((now_s + pause_s - 0.1, "s1"), (now_s + pause_s + 0.1, "s0")):
            only = [attrs.evolve(offers(0)[0], server=name, robots=n) for name, n in (("s0", 0), ("s1", 1))]
            assert choice.order([only], at_s)[0].server == first
        now_s += pause_s + 0.1


@pytest.fixture
def results() -> Results:
    return Results()


def test_one_robot_with_wrong_requests_makes_no_model_fail(results: Results) -> None:
    results.answer("right", 0)
    for _ in range(100):
        results.fail("wrong", 1 * S, "no")
    assert results.failing(1 * S) == ""
    results.fail("right", 2 * S, "no")
    assert results.failing(2 * S) == "no"
    assert results.offered_failing(31 * S)
    assert not results.offered_failing(33 * S), "robots may try it again"
    assert results.failing(33 * S) == "no"


def test_latency_is_forgotten_after_a_minute(results: Results) -> None:
    for took_ns in (1, 2, 9):
        results.took(took_ns, 0)
    assert results.latency_ns(59 * S) == 2
    assert results.latency_ns(61 * S) == 0

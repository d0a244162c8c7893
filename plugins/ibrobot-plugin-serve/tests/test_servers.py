"""Several servers of one model: robots share them, and move when one dies, drains or fails them."""

from __future__ import annotations

import json
import threading
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

import attrs
import numpy as np
import pytest
from ibrobot_serve.fleet import Choice, Offer, drawn_canary, ranked
from ibrobot_serve.wire import WireDecoder, WireEncoder, WireKind, WireMessage, offer_name, server_name
from ibrobot_testing.fakes import FakeTransport

from ibrobot_core.api import Payload, PolicyError

from .served_fleet import PATIENCE_S, Doubles, Fleet


def test_robots_share_the_servers_equally_and_stay_with_theirs(fleet: Fleet) -> None:
    for _ in range(3):
        fleet.server()
    robots = fleet.robots(9)
    first = [robot.ask() for robot in robots]
    assert Counter(first) == {0: 3, 1: 3, 2: 3}
    for robot in robots:
        robot.engine.reset(1)
    assert [robot.ask() for robot in robots] == first


def test_robots_of_a_killed_server_get_the_answers_of_others_to_the_same_requests(fleet: Fleet) -> None:
    for _ in range(3):
        fleet.server()
    robots = fleet.robots(6)
    first = [robot.ask() for robot in robots]
    dead = first[0]
    fleet.policies[dead].entered = threading.Semaphore(0)
    fleet.policies[dead].gate.clear()
    asked = fleet.pool.submit(robots[0].ask)
    assert fleet.policies[dead].entered.acquire(timeout=PATIENCE_S)
    fleet.kill(dead)
    assert asked.result(PATIENCE_S) != dead
    then = [robot.ask() for robot in robots]
    assert Counter(then) == {number: 3 for number in range(3) if number != dead}
    assert all(after == before for before, after in zip(first, then, strict=True) if before != dead)
    assert [robot.engine.stats.failures for robot in robots] == [0] * 6


def test_draining_server_finishes_its_requests_and_its_robots_go_on_elsewhere(fleet: Fleet) -> None:
    fleet.server()
    robots = fleet.robots(2)
    assert [robot.ask() for robot in robots] == [0, 0]
    fleet.server()
    old = fleet.policies[0]
    old.entered = threading.Semaphore(0)
    old.gate.clear()
    pending = fleet.pool.submit(robots[0].ask)
    assert old.entered.acquire(timeout=PATIENCE_S)
    drained = fleet.pool.submit(fleet.servers[0].drain, PATIENCE_S)
    while fleet.servers[0].state != "draining":
        threading.Event().wait(0.002)
    assert fleet.network.served(offer_name("net")) == {offer_name("net", fleet.servers[1].id)}
    assert robots[1].ask() == 1
    assert not drained.done(), "a request is still at work"
    old.gate.set()
    assert drained.result(PATIENCE_S)
    assert pending.result(PATIENCE_S) == 0, "its answer comes from the server that had begun it"
    assert robots[0].ask() == 1
    assert fleet.robot("new").ask() == 1


def test_request_that_reaches_a_draining_server_is_answered_by_another(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    fleet.server()
    robot = fleet.robot()
    robot.ask()
    fleet.server()
    monkeypatch.setattr(fleet.servers[0], "_withdraw", lambda: None)  # the robot has not heard of it yet
    fleet.servers[0].drain(PATIENCE_S)
    assert robot.ask() == 1
    assert robot.engine.stats.failures == 0


def test_canary_gets_its_share_of_the_robots_and_no_other(fleet: Fleet, caplog: pytest.LogCaptureFixture) -> None:
    fleet.server("old")
    fleet.server("new", canary=0.3)
    robots = fleet.robots(10)
    servers = [robot.ask() for robot in robots]
    trying = [robot for robot, server in zip(robots, servers, strict=True) if server == 1]
    assert len(trying) == 2
    assert {robot.engine.stats.weights for robot in trying} == {"new"}
    assert "this robot tries the canary with weights new" in caplog.text
    assert all(fleet.robot(robot.engine._robot, canary=False).ask() == 0 for robot in trying)
    fleet.kill(1)
    assert [robot.ask() for robot in trying] == [0, 0]
    assert {robot.engine.stats.weights for robot in robots} == {"old"}


def test_robots_outside_the_share_of_a_canary_never_use_it(fleet: Fleet) -> None:
    fleet.server("old")
    fleet.server("new", canary=0.3)
    others = [robot for robot in fleet.robots(10) if robot.ask() == 0]
    fleet.kill(0)
    for robot in others:
        with pytest.raises(PolicyError, match=r"nobody serves|are canaries, which this robot does not try"):
            robot.ask()


def test_robots_begin_to_try_a_canary_with_an_episode(fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ibrobot_serve.fleet.SETTLED_S", 0.0)
    fleet.server("old")
    robots = fleet.robots(10)
    assert sum(robot.ask() for robot in robots) == 0
    fleet.server("new", canary=0.3)
    assert sum(robot.ask() for robot in robots) == 0, "not in the middle of an episode"
    for robot in robots:
        robot.engine.reset(1)
    assert sum(robot.ask() for robot in robots) == 2


def test_server_with_other_weights_gets_no_robots(fleet: Fleet) -> None:
    fleet.server("right")
    robots = fleet.robots(4)
    for robot in robots:
        robot.ask()
    fleet.server("wrong")
    for robot in robots:
        robot.engine.reset(1)
        assert robot.ask() == 0
    fleet.kill(0)
    with pytest.raises(PolicyError, match="different weights: hash wrong, previously right"):
        robots[0].ask()
    fleet.server("right")
    assert robots[0].ask() == 2


def test_robot_does_not_start_with_servers_of_different_weights(fleet: Fleet) -> None:
    fleet.server("a1")
    fleet.server("b2")
    with pytest.raises(PolicyError, match=r"have different weights: a1, b2; stop those .* --canary SHARE"):
        fleet.robot().engine.start()
    assert fleet.robot(accept_new_weights=True).ask() in (0, 1)


def test_policy_that_remembers_is_reset_wherever_it_goes_on(fleet: Fleet) -> None:
    for _ in range(2):
        fleet.server(stateful=True)
    robot = fleet.robot(stateful=True)
    first, resets = robot.asked()
    assert robot.asked() == (first, resets) == (first, 1)
    fleet.policies[first].entered = threading.Semaphore(0)
    robot.engine._leave(robot.engine._session, "a fault")  # type: ignore[arg-type]  # it has one
    second = robot.asked()
    assert second == (1 - first, 1)
    robot.engine._choice.avoid(fleet.servers[1 - first].id, time.monotonic())
    robot.engine._choice._avoided.pop(fleet.servers[first].id)
    robot.engine._leave(robot.engine._session, "another")  # type: ignore[arg-type]
    assert robot.asked() == (first, 2), "the first server still has what it remembered before"


def test_robots_of_a_policy_that_remembers_have_a_server_each(fleet: Fleet) -> None:
    for _ in range(3):
        fleet.server(stateful=True)
    robots = [fleet.robot(f"robot{i}", stateful=True) for i in range(3)]
    assert {robot.ask() for robot in robots} == {0, 1, 2}
    with pytest.raises(PolicyError, match="it serves one robot"):
        fleet.robot("one too many", stateful=True).ask()


def offer(**changes: Any) -> dict[str, Any]:
    """What a server says of itself, with changes."""
    honest = {"fingerprint": Doubles().fingerprint(), "weights": "", "spec": {}, "robots": 0}
    return {**honest, "canary": 0, "uptime_s": 9, **changes}


def lying(network: FakeTransport, server: str, answer: Callable[[WireMessage], Payload], **claims: Any) -> None:
    """A server that may claim and answer anything."""
    network.serve(offer_name("net", server), lambda payload, sender: json.dumps(offer(**claims)).encode())
    network.serve(server_name("net", server), lambda payload, sender: answer(WireDecoder().decode(payload)))


def encoded(request: WireMessage, **changes: Any) -> Payload:
    outputs = {"twice": request.tensors["x"] * 2, "server": np.array([9]), "resets": np.array([0])}
    answer = WireMessage(WireKind.ANSWER, request.id, outputs, fingerprint=Doubles().fingerprint())
    return WireEncoder().encode(attrs.evolve(answer, **changes))


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (lambda request: encoded(request, fingerprint="0ther"), "answered request 1 with policy '0ther'"),
        (lambda request: encoded(request, id=request.id + 1), "answered request 2"),
        (lambda request: encoded(request, tensors={"twice": np.array([np.nan])}), "answered with NaN in 'twice'"),
        (lambda request: encoded(request, tensors={"twice": np.array([np.inf])}), "answered with infinity in 'twice'"),
        (lambda request: b"nonsense", "8 bytes; a frame has"),
        (lambda request: encoded(request, kind=WireKind.REFUSAL, tensors={}, text="go away"), "go away"),
    ],
    ids=["other weights than claimed", "another request's answer", "NaN", "infinity", "nonsense", "refusal"],
)
def test_robot_leaves_a_server_that_answers_wrongly(
    fleet: Fleet, caplog: pytest.LogCaptureFixture, answer: Callable[[WireMessage], Payload], said: str
) -> None:
    lying(fleet.network, "liar", answer)
    robot = fleet.robot()
    with pytest.raises(PolicyError, match=said):
        robot.ask()
    assert said in caplog.text
    fleet.server()
    for _ in range(3):
        robot.engine.reset(1)
        assert robot.ask() == 0
    assert robot.engine.stats.failures == 1


@pytest.mark.parametrize(
    "claims",
    [
        {"robots": -1},
        {"robots": "none"},
        {"canary": 1.0},
        {"canary": float("nan")},
        {"uptime_s": float("inf")},
        {"weights": 7},
        {"fingerprint": "f" * 129},
        {"spec": []},
    ],
    ids=str,
)
def test_server_with_an_unbelievable_offer_gets_no_robots(fleet: Fleet, claims: dict[str, Any]) -> None:
    lying(fleet.network, "liar", encoded, **claims)
    with pytest.raises(PolicyError, match="liar is not an ibrobot server: b"):
        fleet.robot().ask()
    fleet.server()
    assert [robot.ask() for robot in fleet.robots(4)] == [0] * 4


def test_server_that_claims_countless_robots_gets_none(fleet: Fleet) -> None:
    fleet.server()
    lying(fleet.network, "liar", encoded, robots=10**300)
    assert [robot.ask() for robot in fleet.robots(4)] == [0] * 4


def test_server_that_comes_and_goes_costs_no_request(fleet: Fleet) -> None:
    fleet.server()
    robots = fleet.robots(4)
    for robot in robots:
        robot.ask()
    for number in range(1, 10):
        fleet.server()
        for robot in robots:
            robot.engine.reset(1)
            assert robot.ask() == 0, "a server of a moment draws nobody away"
        new = fleet.robot(f"new{number}")
        new.ask()
        fleet.kill(number)
        assert new.ask() == 0
        assert new.engine.stats.failures == 0


def offers(*robots: int, uptime_s: float = 9.0) -> list[Offer]:
    return [Offer(f"s{i}", "f", "", {}, each, 0.0, uptime_s) for i, each in enumerate(robots)]


def test_robots_that_choose_at_once_spread_by_their_names() -> None:
    first = Counter(ranked(offers(0, 0, 0), f"robot{i}")[0].server for i in range(300))
    assert all(80 < count < 120 for count in first.values()), first
    for name in map(str, range(300)):
        before, after = ranked(offers(0, 0, 0), name)[0], ranked(offers(0, 0), name)[0]
        assert before.server in (after.server, "s2"), "only robots whose server has left choose another one"


def test_robot_leaves_a_full_server_with_an_episode_for_one_that_has_settled() -> None:
    choice = Choice("robot")
    crowded = offers(4, 1, 1)
    assert choice.reconsider("s0", [crowded], 0.0) in ("s1", "s2")
    assert choice.reconsider("s0", [offers(2, 2, 2)], 0.0) == "s0"
    assert choice.reconsider("s0", [[crowded[0], *offers(4, 1, 1, uptime_s=1.0)[1:]]], 0.0) == "s0"
    assert choice.reconsider("s1", [offers(4, 1, 1, uptime_s=1.0)], 0.0) == "s1"


def test_failed_server_is_tried_last_for_a_while() -> None:
    choice = Choice("robot")
    best = choice.order([offers(0, 0, 0)], 0.0)[0].server
    choice.avoid(best, 0.0)
    assert choice.order([offers(0, 0, 0)], 4.9)[-1].server == best
    assert choice.order([offers(0, 0, 0)], 5.1)[0].server == best


def test_shares_of_canaries() -> None:
    canaries = [
        attrs.evolve(each, fingerprint=name, canary=share)
        for each, (name, share) in zip(offers(0, 0, 0), [("a", 0.1), ("a", 0.1), ("b", 0.2)], strict=True)
    ]
    drawn = Counter(drawn_canary(canaries, f"robot{i}") for i in range(2000))
    assert 150 < drawn["a"] < 250, "two servers of one canary share its robots"
    assert 340 < drawn["b"] < 460
    assert drawn[""] == 2000 - drawn["a"] - drawn["b"]

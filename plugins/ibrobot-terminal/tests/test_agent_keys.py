"""What a person at the panel sees of agents, and grants them by keys."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any, cast

import attrs
import numpy as np
import pytest
from ibrobot_terminal import agent_keys
from ibrobot_terminal.agent_calls import AgentCalls, path_of, planned_path
from ibrobot_terminal.agent_keys import AgentKeys
from ibrobot_terminal.authority import Agent, authority_of
from ibrobot_testing import make_session, stand_in

from ibrobot_core.api import (
    Header,
    IbrobotError,
    JointTrajectory,
    JointTrajectoryPoint,
    ns,
)
from ibrobot_core.app import Session

GOAL = {"goal": "pan=0.4"}
KEYS = "Y lets it move   N refuses   T time   V speed"


def trajectory(*rows: list[float]) -> JointTrajectory:
    points = [JointTrajectoryPoint(ns(0.5 * i), np.array(row)) for i, row in enumerate(rows)]
    return JointTrajectory(Header(0), ("pan", "lift"), tuple(points))


class Rig:
    """A run with an agent, and the keys; its planner answers with `answer`, and `planned` are the requests."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_s = 100.0
        monkeypatch.setattr(agent_keys, "time", SimpleNamespace(monotonic=lambda: self.now_s))
        self.session: Session = make_session()
        control = {"report": {"loop": {}, "counters": {}}, "running": True, "call": lambda do: {}, "stops": 0}
        self.session.control = cast("Any", SimpleNamespace(**control, write_plan=lambda plan: None))
        self.answer: Any = SimpleNamespace(trajectory=trajectory([0.0, 0.1], [0.4, 0.1]), message="")
        self.planned: list[Any] = []
        self.took_s = 0.0
        bus = self.session.bus
        bus.serve(stand_in("/set_mode"), lambda request: None)
        for name in ("/planning/go_to", "/move_action", "/task/step", "/test/dance", "/test/other"):
            bus.serve(stand_in(name), lambda request: 1)
        for name in ("/planning/plan", "/plan_kinematic_path", "/compute_cartesian_path"):
            bus.serve(attrs.evolve(stand_in(name), reads=True), self._answer)
        self.authority = authority_of(self.session)
        self.authority.open()
        self.keys = AgentKeys(self.session)

    def _answer(self, request: Any) -> Any:
        self.planned.append(request)
        self.now_s += self.took_s
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer

    def ask(self, agent: Agent, service: str = "/planning/go_to", request: Any = GOAL) -> None:
        """Call a service that is not granted."""
        with pytest.raises(IbrobotError):
            self.authority.call(agent, service, request)

    def rows(self) -> dict[str, str]:
        """The rows now, once the path is planned."""
        self.keys.rows()
        if self.keys._path is not None:
            self.keys._path[1].exception()  # waits for it
        return dict(self.keys.rows())

    def read(self) -> dict[str, str]:
        """The rows, after a person has read them."""
        rows = self.rows()
        self.now_s += 2.0
        return rows

    def press(self, key: str) -> bool:
        act = self.keys.key(key)
        if act is not None:
            act()
        return act is not None

    def close(self) -> None:
        self.keys.close()
        self.authority.close()


@pytest.fixture
def rig(monkeypatch: pytest.MonkeyPatch) -> Iterator[Rig]:
    made = Rig(monkeypatch)
    yield made
    made.close()


def test_run_without_a_door_for_agents_shows_nothing(rig: Rig) -> None:
    rig.authority.close()
    assert rig.rows() == {}
    assert not any(map(rig.press, "YNTV"))
    rig.authority.open()
    assert rig.rows() == {}


def test_person_allows_nothing_whose_path_is_not_shown_yet(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    agent = rig.authority.join("claude")
    goes_on = threading.Event()

    def slowly(*given: Any) -> Any:
        goes_on.wait(60)
        return planned_path(*given)

    monkeypatch.setattr(agent_keys, "planned_path", slowly)
    rig.ask(agent)
    assert dict(rig.keys.rows())["path"] == "is being planned"
    rig.now_s += 2.0
    assert rig.press("Y")
    assert rig.authority.status().armed == ""
    goes_on.set()
    assert rig.read()["path"] == "up to 2.0 s; pan 0.00 to 0.40 [rad]"
    assert rig.press("Y")
    assert rig.authority.status().armed == "1:claude"


def test_person_sees_who_asks_for_what_and_the_path_and_allows_it(rig: Rig) -> None:
    agent = rig.authority.join("claude")
    assert rig.rows() == {"agents": "1:claude may look, plan and stop"}
    assert not any(map(rig.press, "YNTV")), "nobody asks for anything"
    rig.ask(agent)
    assert rig.read() == {
        "agent": "1:claude asks for /planning/go_to",
        "path": "up to 2.0 s; pan 0.00 to 0.40 [rad]",
        "grant": "120 s, 25% of the speed limits, /planning/go_to, /move_action, /task/step, /task/run",
        "keys": KEYS,
        "request": '{"goal": "pan=0.4"}',
    }
    assert rig.authority.status().armed == ""
    assert rig.press("Y")
    grant = rig.authority.status().grant
    assert grant is not None
    assert (rig.authority.status().armed, grant.seconds, grant.speed, grant.by) == ("1:claude", 120.0, 0.25, "panel")
    assert rig.authority.call(agent, "/planning/go_to", GOAL) == 1
    assert rig.rows() == {"agent": "1:claude may move the robot for 120 s at 25%; N takes it back"}
    assert not rig.press("Y")
    assert rig.press("N")
    assert rig.authority.status().ended == "disarmed"


def test_person_chooses_time_and_speed_before_and_sees_them(rig: Rig) -> None:
    rig.ask(rig.authority.join("claude"))
    rig.read()
    for key in "TTVVV":
        assert rig.press(key)
    assert rig.rows()["grant"].startswith("600 s, 10% of the speed limits")
    assert rig.rows()["path"].startswith("up to 5.0 s")
    rig.press("Y")
    grant = rig.authority.status().grant
    assert grant is not None
    assert (grant.seconds, grant.speed) == (600.0, 0.1)


def test_refused_request_is_gone_until_it_is_asked_again(rig: Rig) -> None:
    agent = rig.authority.join("claude")
    rig.ask(agent)
    rig.read()
    assert rig.press("N")
    assert rig.rows() == {"agents": "1:claude may look, plan and stop"}
    assert not rig.press("Y")
    assert rig.authority.status().armed == ""
    rig.ask(agent)
    assert rig.rows()["agent"] == "1:claude asks for /planning/go_to"


@pytest.mark.parametrize("request_", [{"goal": "pan=-1.0"}, {"goal": "pan=0.4", "x": 1}])
def test_request_that_takes_the_place_of_another_is_not_allowed_by_a_key_for_that_one(rig: Rig, request_: Any) -> None:
    agent = rig.authority.join("claude")
    rig.ask(agent)
    rig.read()
    rig.ask(agent, request=request_)
    rig.rows()
    for _ in range(30):  # a key that is held
        rig.now_s += 0.1
        assert rig.press("Y")
        assert rig.authority.status().armed == ""
    rig.now_s += 2.0
    rig.press("Y")
    assert rig.authority.status().armed == "1:claude"


def test_what_is_drawn_is_what_is_allowed(rig: Rig) -> None:
    first, second = rig.authority.join("claude"), rig.authority.join("hostile")
    rig.ask(first)
    rig.read()
    rig.ask(second, "/test/dance")  # after the person has read, before the panel is drawn again
    rig.press("Y")
    status = rig.authority.status()
    assert status.armed == "1:claude"
    assert status.grant is not None
    assert "/test/dance" not in status.grant.services


def test_same_request_again_does_not_delay_the_person(rig: Rig) -> None:
    agent = rig.authority.join("claude")
    rig.ask(agent)
    rig.read()
    rig.ask(agent)
    rig.rows()
    rig.press("Y")
    assert rig.authority.status().armed == "1:claude"


def test_agent_that_is_gone_asks_for_nothing(rig: Rig) -> None:
    agent = rig.authority.join("claude")
    rig.ask(agent)
    rig.read()
    rig.authority.leave(agent)
    assert rig.rows() == {}
    assert not rig.press("Y")


def test_armed_agent_may_ask_for_more(rig: Rig) -> None:
    agent = rig.authority.join("claude")
    rig.ask(agent)
    rig.read()
    rig.press("Y")
    rig.ask(agent, "/test/dance", {"steps": 3})
    rows = rig.read()
    assert (rows["agent"], rows["path"]) == ("1:claude asks for /test/dance", "known only as it moves")
    assert rows["grant"].endswith(", /test/dance")
    rig.press("Y")
    assert rig.authority.call(agent, "/test/dance") == 1
    rig.ask(agent, "/test/other")
    rig.rows()
    rig.press("N")
    assert rig.authority.status().ended == "disarmed", "an agent that goes on asking keeps nothing"


@pytest.mark.parametrize(
    ("service", "request_", "planned"),
    [
        ("/planning/go_to", "home", {"goal": "home"}),
        ("/move_action", {"goals": [{"pose": "home"}]}, {"goals": [{"pose": "home"}]}),
        ("/task/step", {"move": {"joints": {"pan": 1}, "touch": ["cube"]}}, {"goals": [{"joints": {"pan": 1}}]}),
        (
            "/task/step",
            {"move": {"any": [{"pose": "home"}], "speed": 0.5}},
            {"goals": [{"pose": "home"}], "velocity_scaling": 0.5},
        ),
        (
            "/task/step",
            {"move": {"line": [{"xyz": [0, 0, 1]}], "least_fraction": 0.5}},
            {"waypoints": [{"xyz": [0, 0, 1]}], "least_fraction": 0.5},
        ),
        ("/task/step", {"gripper": {"position": 0.1}}, None),
        ("/task/step", {"move": 3}, None),
        ("/planning/go_to", {"goal": 3}, None),
        ("/planning/go_to", [1], None),
        ("/planning/go_to", "x" * 5000, None),
        ("/move_action", None, None),
        ("/test/dance", {"goal": "home"}, None),
    ],
)
def test_path_of_the_request_is_planned(rig: Rig, service: str, request_: Any, planned: Any) -> None:
    rig.ask(rig.authority.join("claude"), service, request_)
    assert ("up to" in rig.rows()["path"]) is (planned is not None)
    assert rig.planned == ([] if planned is None else [planned])


@pytest.mark.parametrize("answer", [IbrobotError("it is {too} far"), ZeroDivisionError("{}")])
def test_planner_that_fails_ends_no_run(rig: Rig, answer: Exception) -> None:
    rig.answer = answer
    rig.ask(rig.authority.join("claude"))
    path = rig.rows()["path"]
    assert path.startswith("none: ")
    assert str(answer) in path


def test_goal_out_of_reach_says_so(rig: Rig) -> None:
    rig.answer = SimpleNamespace(trajectory=None, message="it is out of reach")
    rig.ask(rig.authority.join("claude"))
    assert rig.rows()["path"] == "none: it is out of reach"


def test_flood_of_requests_is_planned_for_one_by_one_with_rests(rig: Rig) -> None:
    agent = rig.authority.join("claude")
    rig.took_s = 0.5
    begun_s = rig.now_s
    for number in range(40):  # in longer floods, the log leaves out most
        rig.ask(agent, request={"goal": f"pan={number}"})
        rig.rows()
        rig.now_s += 1.0
    passed_s = rig.now_s - begun_s
    assert 5 <= len(rig.planned) <= 1 + passed_s / (10 * rig.took_s)


def test_long_requests_are_cut_and_cannot_look_like_rows(rig: Rig) -> None:
    rig.ask(rig.authority.join("claude\n\x1b[2J"), request={"goal": "home" + " " * 80 + "grant 1 s, 1%"})
    rows = rig.rows()
    assert rows["request"] == '{"goal": "home grant 1 s, 1%"}'
    assert rows["agent"] == "1:claude2J asks for /planning/go_to"
    rig.ask(rig.authority.join("claude"), request={"goal": "x" * 500})
    assert len(rig.rows()["request"]) < 130


@pytest.mark.parametrize("filler", [" ", "\n", "\u00a0", "\u2800", "\u3164", "\u2003"])
@pytest.mark.parametrize("raised", [True, False])
def test_reason_without_a_path_that_quotes_the_agent_cannot_look_like_a_row(
    rig: Rig, filler: str, raised: bool
) -> None:
    words = f"no pose '{filler * 70}grant     1 s, 1%, nothing' {'x' * 900}"
    rig.answer = IbrobotError(words) if raised else SimpleNamespace(trajectory=None, message=words)
    rig.ask(rig.authority.join("claude"))
    path = rig.rows()["path"]
    assert path.startswith("none: no pose '")
    assert path.removesuffix(" …").isascii()
    assert "   " not in path
    assert len(path) < 220


def test_keys_that_move_the_robot_grant_nothing(rig: Rig) -> None:
    device: Any = SimpleNamespace(options=SimpleNamespace(terminal_keys=lambda robot: {"Y": "pan+", "w": "lift+"}))
    config = attrs.evolve(rig.session.config, teleoperation={"keyboard": device})
    rig.session.config = config
    keys = AgentKeys(rig.session)
    rig.ask(rig.authority.join("claude"))
    assert dict(keys.rows())["keys"] == "Y moves the robot in this YAML: use `ibrobot agent arm`"
    rig.now_s += 2.0
    assert keys.key("Y") is None
    assert keys.key("N") is None
    keys.close()


def test_path_names_what_moves_furthest() -> None:
    session = make_session()
    names = ("a", "b", "c", "d", "e")
    points = [
        JointTrajectoryPoint(ns(i), np.array(row)) for i, row in enumerate([[0.0] * 5, [0.1, -0.5, 0.005, 0.3, 0.2]])
    ]
    answer = SimpleNamespace(trajectory=JointTrajectory(Header(0), names, tuple(points)), message="")
    assert path_of(session, answer).text == "b 0.00 to -0.50, d 0.00 to 0.30, e 0.00 to 0.20, and 1 more [rad]"
    still = SimpleNamespace(trajectory=JointTrajectory(Header(0), names, tuple(points[:1])), message="")
    assert path_of(session, still).text == "ends where it begins [rad]"


def test_calls_are_counted_once_closed_no_more(rig: Rig) -> None:
    calls = AgentCalls(rig.session)
    agent = rig.authority.join("claude")
    rig.ask(agent)
    rig.ask(agent)
    assert calls.newest is not None
    assert calls.newest.number == 2
    calls.close()
    calls.close()
    rig.ask(agent)
    assert calls.newest.number == 2


@pytest.mark.parametrize(("length", "more"), [(300, ""), (301, " … and 1 characters more"), (1900, " … and 1600 ")])
def test_a_request_that_is_cut_says_so(rig: Rig, length: int, more: str) -> None:
    calls = AgentCalls(rig.session)
    agent = rig.authority.join("claude")
    rig.ask(agent, request="home ".ljust(length - 2, "x"))
    assert calls.newest is not None
    assert calls.newest.request.startswith('"home xx')
    assert calls.newest.request[300:].startswith(more)
    assert bool(calls.newest.request[300:]) is bool(more)
    calls.close()

"""The commands of pages: each calls its service of the run, and a failure is its answer; the emergency stop."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterator, Mapping
from types import SimpleNamespace
from typing import Any

import pytest
from ibrobot_testing import make_session, stand_in
from ibrobot_web import messages
from ibrobot_web.commands import Commands
from ibrobot_web.messages import RunCommand, Sent
from ibrobot_web.teleop import JOG

from ibrobot_core.api import IbrobotError
from ibrobot_core.app import Session

_WAIT_S = 60.0
GO_HOME = messages.Call("/planning/go_to", "home")
SERVICES: dict[str, tuple[RunCommand, Any]] = {
    "/reset": (messages.Reset(), {"stops": 0}),
    **{name: (messages.Call(name, {"a": [name]}), {"a": [name]}) for name in messages.SERVICES},
}
"""Service -> the command that calls it, and its argument."""


class Control:
    """What a run knows of control: the number of emergency stops."""

    def __init__(self) -> None:
        self.stops = 0
        self.running = True
        self.called = threading.Event()
        self.may_answer = threading.Event()
        self.may_answer.set()

    def call(self, command: Any) -> Mapping[str, Any]:
        if type(command).__name__ == "GetCounters":  # the trial at the start
            return {}
        assert type(command).__name__ == "EmergencyStop"
        self.called.set()
        assert self.may_answer.wait(_WAIT_S)
        self.stops += 1
        return {}


class Rig:
    """The commands of a page, in a run that serves some services."""

    def __init__(self, services: Mapping[str, Callable[[Any], Any]]) -> None:
        self.session: Session = make_session()
        found: Any = Control()
        self.session.control = self.control = found
        for name, handler in services.items():
            self.session.bus.unserve(name)
            self.session.bus.serve(stand_in(name), handler)
        self.replies: queue.SimpleQueue[Mapping[str, Any]] = queue.SimpleQueue()
        self.failures: queue.SimpleQueue[Exception] = queue.SimpleQueue()
        self.finished = threading.Event()
        self.commands = Commands(self.session, self.finished.set, self.replies.put, self.failures.put)

    def send(self, *commands: RunCommand, stops: int | None = 0, first: int = 0) -> None:
        for number, command in enumerate(commands, first):
            self.commands.take(Sent(number, stops, command))

    def answers(self, count: int) -> list[Mapping[str, Any]]:
        return sorted((self.replies.get(timeout=_WAIT_S) for _ in range(count)), key=lambda reply: int(reply["reply"]))


@pytest.fixture
def rig() -> Iterator[Callable[..., Rig]]:
    made: list[Rig] = []

    def make(services: Mapping[str, Callable[[Any], Any]]) -> Rig:
        made.append(Rig(services))
        return made[-1]

    yield make
    for each in made:
        each.control.may_answer.set()
        each.commands.close(_WAIT_S)


def answers(services: Mapping[str, Any], *commands: RunCommand) -> list[Mapping[str, Any]]:
    """The replies to commands in a run that serves some services."""
    found = Rig(services)
    try:
        found.send(*commands)
        return found.answers(len(commands))
    finally:
        found.commands.close(_WAIT_S)


@pytest.mark.parametrize("service", SERVICES)
def test_each_calls_its_service(service: str) -> None:
    message, argument = SERVICES[service]
    (reply,) = answers({service: lambda given: f"got {given!r}"}, message)
    assert reply == {"reply": 0, "ok": f"got {argument!r}"}


def test_a_failure_is_the_answer_and_harms_no_other_command() -> None:
    def fails(_: object) -> None:
        raise IbrobotError("the disk is full")

    def breaks(_: object) -> None:
        raise KeyError("a bug")

    found = answers(
        {"/record_episode/start": fails, "/reset": breaks, "/planning/cancel": lambda _: "cancelled"},
        messages.Call("/record_episode/start"),
        messages.Reset(),
        messages.Call("/planning/cancel"),
    )
    assert found[0]["error"] == "the disk is full"
    assert "KeyError" in found[1]["error"]
    assert found[2]["ok"] == "cancelled"


def test_a_stop_waits_for_no_command_and_empties_the_queue(rig: Callable[..., Rig]) -> None:
    recovering, may_go_on = threading.Event(), threading.Event()
    ran: list[str] = []

    def recovers(_: object) -> str:
        recovering.set()
        assert may_go_on.wait(_WAIT_S)
        return "recovered"

    found = rig({"/reset": recovers, "/planning/go_to": ran.append, "/set_mode": ran.append})
    found.send(messages.Reset(), GO_HOME, messages.Call("/set_mode", "web"))
    assert recovering.wait(_WAIT_S)
    found.commands.stop(3)
    stopped = found.answers(3)
    may_go_on.set()
    assert [each["reply"] for each in stopped] == [1, 2, 3]
    assert all("an emergency stop came after" in each["error"] for each in stopped[:2])
    assert stopped[2] == {"reply": 3, "ok": None}
    assert found.answers(1) == [{"reply": 0, "ok": "recovered"}]
    assert ran == []


def test_what_was_sent_before_a_stop_and_arrives_after_it_is_refused(rig: Callable[..., Rig]) -> None:
    ran: list[Any] = []
    found = rig(
        dict.fromkeys(("/reset", "/planning/go_to", "/set_mode", "/intervene", "/record_episode/start"), ran.append)
    )
    found.commands.stop(0)
    found.answers(1)
    sent = (
        GO_HOME,
        messages.Call("/set_mode", "web"),
        messages.Call("/intervene", False),
        messages.Call("/record_episode/start"),
    )
    for stops in (0, None):
        found.send(*sent, stops=stops)
        assert all("an emergency stop came after" in each["error"] for each in found.answers(len(sent)))
    assert ran == []
    found.send(messages.Reset(), stops=0)
    found.answers(1)
    assert ran == [{"stops": 0}], "control refuses a reset that has not seen the stop"
    found.send(messages.Reset(), GO_HOME, stops=1)
    assert all("ok" in each for each in found.answers(2))
    assert ran == [{"stops": 0}, {"stops": 1}, "home"]


def test_many_stops_are_one_for_the_run_and_each_is_answered(rig: Callable[..., Rig]) -> None:
    found = rig({})
    found.control.may_answer.clear()
    found.commands.stop(0)
    assert found.control.called.wait(_WAIT_S)
    for number in range(1, 1001):
        found.commands.stop(number)
    found.control.may_answer.set()
    assert found.answers(1001) == [{"reply": number, "ok": None} for number in range(1001)]
    assert found.control.stops == 2, "the one that was on its way, and one for all that came meanwhile"


def test_a_stop_that_control_does_not_confirm_is_an_error(rig: Callable[..., Rig]) -> None:
    def call(command: object) -> None:
        raise IbrobotError("control did not answer")

    found = rig({})
    found.control.call = call
    found.commands.stop(0)
    assert found.answers(1) == [{"reply": 0, "error": "control did not answer"}]


def test_a_thread_that_ends_by_an_error_is_reported(rig: Callable[..., Rig]) -> None:
    found = rig({})

    def fails(reply: Mapping[str, Any]) -> None:
        raise RuntimeError("a bug")

    found.commands._reply = fails
    found.commands.stop(0)
    assert str(found.failures.get(timeout=_WAIT_S)) == "a bug"


def test_the_page_can_end_the_run(rig: Callable[..., Rig]) -> None:
    found = rig({})
    found.send(messages.Finish(), stops=None)
    assert found.answers(1) == [{"reply": 0, "ok": None}]
    assert found.finished.is_set()


@pytest.mark.parametrize(
    ("age_ms", "why"), [(0, ""), (100, ""), (300, "the connection is too slow to jog (0.3 s)"), (-100, "time is wrong")]
)
def test_a_message_of_the_deadman_counts_while_it_is_young(rig: Callable[..., Rig], age_ms: int, why: str) -> None:
    taken: list[Any] = []
    found = rig({"/web_teleop/jog": taken.append})
    now_ns, at = found.session.clock.now_ns(), messages.clock_ms() - age_ms
    found.send(messages.Jog(at, at, joints={"gripper": 0.5}))
    (answer,) = found.answers(1)
    if why:
        assert why in answer["error"]
        assert taken == []
    else:
        assert taken[0].joints == {"gripper": 0.5}
        assert taken[0].made_ns == taken[0].began_ns, "which the deadman would otherwise take for an old press"
        assert taken[0].made_ns == pytest.approx(now_ns - age_ms * 1_000_000, abs=5_000_000)


def test_the_thread_of_stops_exists_and_gives_signs_of_life(rig: Callable[..., Rig], monkeypatch: pytest.MonkeyPatch):
    made = rig({})
    (pulse,) = made.session.pulses

    def refuse(thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", refuse)
    for number in range(3):
        beats = pulse._beats
        made.commands.stop(number)
        assert made.replies.get(timeout=_WAIT_S) == {"reply": number, "ok": None}
        assert pulse._beats > beats
    monkeypatch.undo()
    made.commands.close(_WAIT_S)
    assert not made.session.pulses


def test_a_stop_that_would_fail_ends_the_run_at_its_start():
    session = make_session()
    control: Any = Control()

    def call(command: object) -> Mapping[str, Any]:
        raise IbrobotError("control does not answer")

    control.call = call
    session.control = control
    failures: queue.SimpleQueue[Exception] = queue.SimpleQueue()
    commands = Commands(session, lambda: None, lambda reply: None, failures.put)
    assert "control does not answer" in str(failures.get(timeout=_WAIT_S))
    commands.close(_WAIT_S)


@pytest.mark.parametrize("press", [6, 100, 3_600_000, 2**52])
@pytest.mark.parametrize("ahead", [-20, 0, 4])
def test_a_press_in_the_future_is_refused(rig: Callable[..., Rig], ahead: int, press: int) -> None:
    """It would count as a new press with each message, so that one held over a stop and its reset would move."""
    asked: list[Any] = []
    made = rig({JOG.name: asked.append})
    at = messages.clock_ms() + ahead
    made.send(messages.Jog(at=at, press=at + press), messages.Jog(at=at, press=at), messages.Jog(at=at, press=at - 50))
    refused, *taken = made.answers(3)
    assert refused["error"] == "the page's time is wrong; press again"
    assert [each.get("error") for each in taken] == [None, None]
    assert len(asked) == 2


@pytest.mark.parametrize(
    ("now", "ends"),
    [
        ({"episode": 3, "recording": True}, [("stop", "unknown")]),
        ({"episode": 3, "recording": False}, []),
        ({"episode": 4, "recording": True}, []),  # one that another program began
        ({"episode": 2, "waiting": True}, [("discard", None)]),
    ],
    ids=["recording", "ended", "another", "waiting"],
)
@pytest.mark.parametrize("begins", ["start", "redo"])
def test_the_episode_of_a_page_that_is_gone_ends(
    rig: Callable[..., Rig], begins: str, now: Mapping[str, Any], ends: list[tuple[str, Any]]
) -> None:
    status = SimpleNamespace(episode=2, recording=False, waiting=False)
    called: list[tuple[str, Any]] = []

    def begin(_: object) -> None:
        status.episode, status.recording = 3, True

    services: dict[str, Callable[[Any], Any]] = {
        begins: begin,
        "status": lambda _: status,
        "stop": lambda given: called.append(("stop", given)),
        "discard": lambda given: called.append(("discard", given)),
    }
    found = rig({f"/record_episode/{name}": handler for name, handler in services.items()})
    found.send(messages.Abandoned())
    found.answers(1)
    assert called == [], "no page has begun one"
    found.send(messages.Call(f"/record_episode/{begins}"))
    found.answers(1)
    vars(status).update({"recording": False, **now})
    found.send(messages.Abandoned(), messages.Abandoned(), stops=None)
    found.answers(2)
    assert called[:1] == ends

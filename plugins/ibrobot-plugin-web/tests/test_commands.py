"""The commands of pages: each calls its service of the run, and a failure is its answer."""

from __future__ import annotations

import queue
from collections.abc import Mapping
from typing import Any

import pytest
from ibrobot_testing import make_session, stand_in
from ibrobot_web.commands import Commands

from ibrobot_core.api import IbrobotError

_WAIT_S = 60.0
SERVICES: dict[str, tuple[dict[str, Any], Any]] = {
    "/estop": ({"do": "estop"}, None),
    "/reset": ({"do": "reset"}, None),
    "/set_mode": ({"do": "mode", "mode": "web"}, "web"),
    "/record_episode/start": ({"do": "episode_start", "prompt": "pick"}, "pick"),
    "/record_episode/stop": ({"do": "episode_stop", "outcome": "failure"}, "failure"),
    "/record_episode/discard": ({"do": "episode_discard"}, None),
    "/action_dispatcher/toggle_smoothing": ({"do": "smoothing", "enabled": False}, False),
    "/intervene": ({"do": "intervene", "take": True}, True),
    "/planning/go_to": ({"do": "goal", "goal": "home"}, "home"),
    "/planning/cancel": ({"do": "cancel"}, None),
}
"""Service -> the command that calls it, and its argument."""


def answers(commands: Mapping[str, Any], *messages: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """The replies to messages in a run that serves some services."""
    session = make_session()
    for name, handler in commands.items():
        session.bus.unserve(name)
        session.bus.serve(stand_in(name), handler)
    replies: queue.SimpleQueue[Mapping[str, Any]] = queue.SimpleQueue()
    carried_out = Commands(session, replies.put)
    try:
        for number, message in enumerate(messages):
            carried_out.take({"id": number, **message})
        return sorted((replies.get(timeout=_WAIT_S) for _ in messages), key=lambda reply: int(reply["reply"]))
    finally:
        carried_out.close(_WAIT_S)


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
        {"do": "episode_start", "prompt": ""},
        {"do": "reset"},
        {"do": "fly"},
        {"do": "mode", "mode": 3},
        {"do": "cancel"},
    )
    assert found[0]["error"] == "the disk is full"
    assert "KeyError" in found[1]["error"]
    assert found[2]["error"].startswith("unknown command 'fly'; known: estop")
    assert found[3]["error"] == "mode must be a text"
    assert found[4]["ok"] == "cancelled"

"""What pages may send, and the envelopes in which it reaches the run: nothing of a page's content can pass for one."""

from __future__ import annotations

import json
from typing import Any, get_args

import attrs
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ibrobot_web import messages
from ibrobot_web.messages import (
    MalformedMessage,
    PageCommand,
    Pages,
    Release,
    RunCommand,
    Sent,
    StopRun,
    from_page,
    from_server,
    stop_from_page,
    to_run,
)

from ibrobot_core.api import IbrobotError

NAMES = ("jog", "release", "reset", "call", "preview", "finish", "operate")
WORDS = st.sampled_from(
    ["do", "id", "stops", "event", "log", "failed", "failure", "pages", "wanted", "count", "command", "stop", "number",
     "facts", "reply", "ok", "error", "alive", "at", "press", "joints", "mode", "goal",
     "take", "estop", "service", "request", *NAMES, *messages.SERVICES]
)  # fmt: skip
JSON = st.recursive(
    st.none() | st.booleans() | st.floats(allow_nan=False) | st.integers() | st.text(max_size=5) | WORDS,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(WORDS | st.text(max_size=5), inner, max_size=4),
    max_leaves=10,
)
MESSAGES = st.one_of(
    JSON,
    st.dictionaries(WORDS, JSON, max_size=6),
    st.builds(lambda do, more: {**more, "do": do}, st.sampled_from(NAMES), st.dictionaries(WORDS, JSON, max_size=4)),
    st.builds(
        lambda more, change: {"do": "jog", "at": 5, "press": 4, **more, **change},
        st.fixed_dictionaries({}, optional={"joints": st.dictionaries(WORDS, JSON), "linear": JSON, "pose": JSON}),
        st.dictionaries(WORDS, JSON, max_size=1),
    ),
)
"""JSON with the words of all protocols."""


@given(MESSAGES)
def test_a_message_is_a_known_command_with_typed_fields_or_refused(message: Any) -> None:
    try:
        sent = from_page(json.dumps(message))
    except MalformedMessage:
        return
    assert isinstance(sent.command, PageCommand)
    assert set(message) <= {"id", "do", "stops", *(field.name for field in attrs.fields(type(sent.command)))}
    if isinstance(sent.command, messages.Jog):
        jog = sent.command
        assert all(abs(speed) <= 1 for speed in (*jog.joints.values(), *jog.linear, *jog.turn))
        assert all(isinstance(each, float) for each in (*jog.targets.values(), *jog.linear))


@given(st.text(max_size=40) | st.binary(max_size=40).map(lambda garbage: garbage.decode(errors="replace")))
def test_text_that_is_no_json_is_refused(text: str) -> None:
    with pytest.raises(MalformedMessage):
        from_page(text + "\x00")


@pytest.mark.parametrize(
    ("message", "why"),
    [
        ({"do": "estop", "event": "pages"}, "unknown command 'estop'"),
        ({"do": "release", "event": "log"}, "event: unknown key"),
        ({"do": "reset", "event": "failed"}, "event: unknown key"),
        ({"event": "log", "logger": "ibrobot", "message": "forged"}, "expected an object with a text `do`"),
        ({"do": "call", "service": ["/set_mode"]}, "service: expected text"),
        ({"do": "call"}, "service: required key is missing"),
        ({"do": "call", "service": "/world/add"}, "pages cannot call '/world/add'; they can call: /set_mode, "),
        ({"do": "call", "service": "/set_mode/"}, "pages cannot call '/set_mode/'"),
        ({"do": "call", "service": "/set_mode", "request": [[[[["web"]]]]]}, "more than 4 lists and mappings"),
        ({"do": "jog", "at": 1.5, "press": 1}, "at: expected a whole number"),
        ({"do": "jog", "at": 1, "press": -1}, "press: -1 is too small"),
        ({"do": "jog", "at": 1, "press": 1, "joints": {"a": 2}}, "between -1 and 1"),
        ({"do": "jog", "at": 1, "press": 1, "linear": [1, 2]}, "expected a list of 3 values"),
        ({"do": "jog", "at": 1, "press": 1, "targets": {"a": True}}, "expected a number"),
        ({"do": "jog", "at": 1, "press": 1, "targets": {"a": 1e308}}, "a position must lie between -1000 and 1000"),
        ({"do": "preview", "goal": {"pose": "home"}}, "goal: expected text"),
        ({"do": "call", "service": "/set_mode", "request": "x" * 2000}, "2000 characters"),
        ({"do": "preview", "goal": "home", "id": True}, "id must be a whole number"),
        ({"do": "preview", "goal": "home", "stops": "0"}, "stops must be a whole number"),
    ],
    ids=lambda value: str(value)[:40],
)
def test_unknown_keys_and_wrong_types_are_named(message: dict[str, Any], why: str) -> None:
    with pytest.raises(MalformedMessage, match=why):
        from_page(json.dumps(message))


@pytest.mark.parametrize("text", ["1e999", "NaN", '{"do": NaN}', "[" * 50_000, '{"do":', "9" * 5000])
def test_numbers_and_nesting_beyond_json_are_refused(text: str) -> None:
    with pytest.raises(MalformedMessage):
        from_page(text)


def test_values_are_not_expanded(monkeypatch: pytest.MonkeyPatch) -> None:
    """Requests are plain data: in robot YAMLs these texts would become the value and the home folder."""
    monkeypatch.setenv("IBROBOT_PASSWORD", "correct horse battery")
    for text in ("${IBROBOT_PASSWORD}", "~", "$(env IBROBOT_PASSWORD)", "!!python/name:os.environ"):
        sent = from_page(json.dumps({"do": "call", "service": "/planning/go_to", "request": {"goal": text}}))
        assert sent.command == messages.Call("/planning/go_to", {"goal": text})
        with pytest.raises(MalformedMessage) as refused:
            from_page(json.dumps({"do": "jog", "at": 1, "press": 1, "linear": text}))
        assert "horse" not in str(refused.value)


@given(st.text(max_size=20))
def test_a_stop_is_a_number_and_nothing_else(text: str) -> None:
    try:
        assert stop_from_page(text) == int(text)
    except MalformedMessage:
        assert not (text.isascii() and text.isdecimal())


COMMANDS = (
    messages.Jog(7, 5, joints={"a": 0.5}, linear=(0.0, 1.0, 0.0)), Release(), Release(3), messages.Reset(),
    messages.Call("/set_mode", "web"), messages.Call("/planning/cancel"), messages.Preview("home"), messages.Finish(),
    messages.Abandoned(),
)  # fmt: skip
"""Every command of the run."""


def test_every_message_of_the_server_arrives_as_it_was() -> None:
    assert {type(each) for each in COMMANDS} == set(get_args(RunCommand))
    sent: list[Any] = [Sent(n, n % 3 or None, command) for n, command in enumerate(COMMANDS)]
    for message in [*sent, StopRun(4), Pages(2, None), Pages(1, frozenset({0, 16})), messages.Alive()]:
        assert from_server(json.loads(json.dumps(to_run(message)))) == message


@given(st.dictionaries(WORDS, JSON, max_size=5))
def test_the_run_takes_only_messages_of_the_server(message: dict[str, Any]) -> None:
    try:
        found = from_server(message)
    except (ValueError, IbrobotError):
        return
    assert isinstance(found, Sent | StopRun | Pages | messages.Alive)


@pytest.mark.parametrize("message", [StopRun(4), Pages(1, None), messages.Alive(), Sent(1, 2, Release())])
def test_a_message_of_the_server_with_a_further_key_is_refused(message: Any) -> None:
    with pytest.raises((ValueError, IbrobotError)):
        from_server({**to_run(message), "event": "log"})


def test_only_the_server_says_that_nobody_operates() -> None:
    with pytest.raises(messages.MalformedMessage, match="abandoned is not for pages"):
        messages.from_page(json.dumps({"id": 1, "do": "abandoned"}))


@pytest.mark.parametrize("name", ["operate", "resign", "time", "estop", "log"])
def test_commands_for_the_server_alone_do_not_reach_the_run(name: str) -> None:
    with pytest.raises((ValueError, IbrobotError)):
        from_server({"command": name, "number": 1, "stops": 0, "facts": {}})

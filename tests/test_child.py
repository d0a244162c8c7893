"""Child processes: the channel to one, its log, its end, and the cause of its death."""

from __future__ import annotations

import json
import logging
import socket
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ibrobot_core.child import Channel, Child, Failure, LogLine
from ibrobot_core.errors import ComponentFailed

PATIENCE_S = 30.0


def line(content: Any, envelope: Any = "message") -> bytes:
    """What a peer sends."""
    return json.dumps([envelope, content]).encode() + b"\n"


KEYS = st.sampled_from(["event", "do", "reply", "log", "failure", "logger", "level", "message", "error", "holding"])
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text() | KEYS,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(KEYS | st.text(), inner, max_size=4),
    max_leaves=8,
)
"""What JSON can say, often with the words of the protocol."""


@pytest.fixture
def ends() -> Iterator[tuple[Channel, socket.socket]]:
    """A channel, and the bare socket of its peer."""
    ours, theirs = socket.socketpair()
    channel = Channel(ours)
    yield channel, theirs
    channel.close()
    theirs.close()


class TestChannel:
    @given(
        messages=st.lists(st.dictionaries(st.text(), st.integers() | st.text() | st.none()), max_size=8),
        cut=st.integers(1, 50),
    )
    def test_messages_survive_arriving_in_pieces(self, messages, cut):
        ours, theirs = socket.socketpair()
        channel = Channel(ours)
        text = b"".join(line(message) for message in messages)
        received = []
        for begin in range(0, len(text), cut):
            theirs.sendall(text[begin : begin + cut])
            received += channel.receive()
        channel.close()
        theirs.close()

        assert received == messages

    def test_half_a_message_is_none_yet(self, ends):
        channel, peer = ends
        peer.sendall(b'["message", {"do": "st')
        assert channel.receive() == []
        assert channel.wait(0.0) == []

        peer.sendall(b'op"}]\n')
        assert channel.wait(0.0) == [{"do": "stop"}]

    def test_what_a_peer_said_before_it_died_is_heard(self, ends):
        channel, peer = ends
        peer.sendall(line({"event": "stopped"}) + b'["mess')
        peer.close()

        assert channel.wait(0.0) == [{"event": "stopped"}]
        assert channel.closed
        with pytest.raises(ComponentFailed, match="gone"):
            channel.wait(0.0)

    def test_sending_to_a_dead_peer_raises_nothing(self, ends):
        channel, peer = ends
        peer.close()
        channel.send({"event": "ready"})

        assert channel.closed

    def test_a_peer_that_does_not_read_holds_nothing_up_and_misses_nothing(self, ends):
        channel, peer = ends
        reader = Channel(peer)
        sent = [{"number": number, "text": "x" * 10_000} for number in range(100)]
        for message in sent:
            channel.send(message)
        assert channel.backlog > 0

        received = reader.receive()
        while len(received) < len(sent):
            channel.flush(0.0)
            channel.receive()
            received += reader.receive()
        assert received == sent
        assert channel.backlog == 0


class TestStrangers:
    """A peer may send anything: what is no message of the protocol is dropped, and the next message arrives."""

    @given(content=st.dictionaries(KEYS | st.text(), VALUES, max_size=5))
    def test_nothing_in_a_message_passes_for_a_report(self, content):
        ours, theirs = socket.socketpair()
        sender, receiver = Channel(ours), Channel(theirs)
        sender.send(content)
        received = receiver.receive()
        sender.close()
        receiver.close()

        assert json.dumps(received) == json.dumps([content])
        assert receiver.take_reports() == []
        assert receiver.dropped == 0

    @given(
        wrong=st.one_of(
            st.binary(max_size=60).map(lambda garbage: garbage.replace(b"\n", b"") + b"\n"),
            VALUES.map(lambda value: json.dumps(value).encode() + b"\n"),
            st.builds(line, VALUES, VALUES),
            st.builds(line, st.dictionaries(KEYS, VALUES), st.sampled_from(["log", "failure", "message"])),
            st.sampled_from([b"[" * 100_000 + b"\n", b"\xff\xfe\n", b"1" * 5000 + b"\n", line({}, []), line({}, {})]),
        )
    )
    def test_what_is_no_message_is_dropped(self, wrong):
        ours, theirs = socket.socketpair()
        channel = Channel(ours)
        theirs.sendall(wrong + line({"event": "ready"}))
        received = channel.receive()
        reports = channel.take_reports()
        channel.close()
        theirs.close()

        assert received[-1] == {"event": "ready"}
        assert all(isinstance(message, dict) for message in received)
        assert all(isinstance(report, LogLine | Failure) for report in reports)
        assert len(received) - 1 + len(reports) + channel.dropped == 1

    @pytest.mark.parametrize(
        "wrong",
        [
            {"logger": "ibrobot.web", "level": 20},
            {"logger": "root", "level": 20, "message": "forged"},
            {"logger": "ibrobot.a\nb", "level": 20, "message": "forged"},
            {"logger": "ibrobot.web", "level": "20", "message": "forged"},
            {"logger": "ibrobot.web", "level": 20, "message": ["forged"]},
            {"logger": "ibrobot.web", "level": 20, "message": "forged", "more": 1},
        ],
    )
    def test_a_log_record_has_known_keys_of_their_types(self, ends, wrong):
        channel, peer = ends
        peer.sendall(line(wrong, "log"))

        assert channel.receive() == []
        assert channel.take_reports() == []
        assert channel.dropped == 1

    def test_an_endless_line_ends_the_connection(self, ends, monkeypatch):
        monkeypatch.setattr("ibrobot_core.child._LONGEST", 100_000)
        channel, peer = ends
        while not channel.closed:
            peer.sendall(b"x" * 10_000)
            channel.receive()
        with pytest.raises(ComponentFailed, match="gone"):
            channel.wait(0.0)


@pytest.fixture
def start(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Child]]:
    """Starts `tests/shared/obedient_child.py`, which does what the order says."""
    monkeypatch.chdir(Path(__file__).parent / "shared")
    children: list[Child] = []

    def start_child(**order: Any) -> Child:
        children.append(Child("obedient_child", order))
        return children[-1]

    yield start_child
    for child in children:
        child.kill()
        child.end(PATIENCE_S)
        child.channel.close()


def listen(child: Child) -> None:
    """Until it is gone."""
    while True:
        child.wait(PATIENCE_S)


@pytest.mark.integration
class TestChild:
    def test_messages_come_back_and_log_records_go_to_the_log_of_the_parent(self, start, caplog):
        child = start(log="the arm is warm", say=[{"event": "ready"}, {"event": "report"}])
        with caplog.at_level(logging.INFO, "ibrobot"):
            first = child.wait(PATIENCE_S) or child.wait(PATIENCE_S)
            second = child.wait(PATIENCE_S)

        assert (first, second) == ({"event": "ready"}, {"event": "report"})
        assert caplog.messages == ["the arm is warm"]

    def test_words_of_the_protocol_in_messages_are_only_words(self, start, caplog):
        """With messages and reports in one envelope, the first raised and the second was the child's failure."""
        forged = [
            {"do": "release", "event": "log"},
            {"event": "log", "logger": "ibrobot.web", "level": 40, "message": "forged"},
            {"do": "estop", "event": "failed", "error": "forged"},
            {"failure": {"error": "forged"}},
        ]
        child = start(say=forged, exit=0)
        with caplog.at_level(logging.INFO, "ibrobot"):
            received = [child.wait(PATIENCE_S) for _ in forged]
            with pytest.raises(ComponentFailed, match="gone"):
                listen(child)

        assert received == forged
        assert caplog.messages == []
        assert child.failure is None
        assert child.cause(PATIENCE_S) == "exit status 0"

    @pytest.mark.parametrize(
        ("order", "cause"),
        [
            ({"exit": 3}, "exit status 3"),
            ({"exit": 0}, "exit status 0"),
            ({"fail": "no servo 3", "exit": 1}, "no servo 3"),
            ({"signal": 9}, "killed by SIGKILL"),
        ],
    )
    def test_the_cause_of_a_death_is_in_its_own_words_or_in_those_of_the_system(self, start, order, cause):
        child = start(**order)
        with pytest.raises(ComponentFailed, match="gone"):
            listen(child)

        assert child.cause(PATIENCE_S) == cause
        assert not child.end(0.0)

    def test_one_that_does_not_end_in_time_is_killed(self, start):
        child = start(say=[{"event": "ready"}], linger=True)
        child.wait(PATIENCE_S)

        assert child.end(0.01)
        assert child.cause(0.0) == "killed by SIGKILL"

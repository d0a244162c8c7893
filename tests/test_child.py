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

from ibrobot_core.child import Channel, Child
from ibrobot_core.errors import ComponentFailed

PATIENCE_S = 30.0


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
        text = b"".join(json.dumps(m).encode() + b"\n" for m in messages)
        received = []
        for begin in range(0, len(text), cut):
            theirs.sendall(text[begin : begin + cut])
            received += channel.receive()
        channel.close()
        theirs.close()

        assert received == messages

    def test_half_a_message_is_none_yet(self, ends):
        channel, peer = ends
        peer.sendall(b'{"do": "st')
        assert channel.receive() == []
        assert channel.wait(0.0) == []

        peer.sendall(b'op"}\n')
        assert channel.wait(0.0) == [{"do": "stop"}]

    def test_what_a_peer_said_before_it_died_is_heard(self, ends):
        channel, peer = ends
        peer.sendall(b'{"event": "failed"}\n{"ev')
        peer.close()

        assert channel.wait(0.0) == [{"event": "failed"}]
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

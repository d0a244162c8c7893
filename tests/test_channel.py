"""Channels between processes: messages with bytes, whatever the peer does, and what is no message."""

from __future__ import annotations

import ast
import json
import socket
import struct
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

import ibrobot_core.channel
from ibrobot_core.channel import Channel

PATIENCE_S = 30.0


def frame(content: Any, word: Any = "message", payload: bytes = b"") -> bytes:
    """What a peer sends."""
    return framed(json.dumps([word, content]).encode(), payload)


def framed(text: bytes, payload: bytes = b"") -> bytes:
    """A frame with any text."""
    return struct.pack("<II", len(text), len(payload)) + text + payload


KEYS = st.sampled_from(["event", "do", "reply", "log", "failure", "logger", "level", "message", "error", "holding"])
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text() | KEYS,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(KEYS | st.text(), inner, max_size=4),
    max_leaves=8,
)
"""What JSON can say, often with the words of the protocol."""
MESSAGES = st.lists(
    st.tuples(st.dictionaries(st.text(), st.integers() | st.text() | st.none()), st.binary(max_size=80)), max_size=8
)


def plain(received: list[Any]) -> list[tuple[dict[str, Any], bytes]]:
    """Messages as tuples."""
    return [(dict(message), bytes(message.payload)) for message in received]


@pytest.fixture
def ends() -> Iterator[tuple[Channel, socket.socket]]:
    """A channel, and the bare socket of its peer."""
    ours, theirs = socket.socketpair()
    channel = Channel(ours)
    yield channel, theirs
    channel.close()
    theirs.close()


class TestChannel:
    @given(messages=MESSAGES, cut=st.integers(1, 50))
    def test_messages_survive_arriving_in_pieces(self, messages, cut):
        ours, theirs = socket.socketpair()
        channel = Channel(ours)
        stream = b"".join(frame(message, payload=payload) for message, payload in messages)
        received = []
        for begin in range(0, len(stream), cut):
            theirs.sendall(stream[begin : begin + cut])
            received += channel.receive()
        channel.close()
        theirs.close()

        assert plain(received) == messages

    @given(messages=MESSAGES, together=st.booleans())
    def test_what_one_end_sends_the_other_receives(self, messages, together):
        here, there = map(Channel, socket.socketpair())
        if together:
            here.send_all(messages)
        else:
            for message, payload in messages:
                here.send(message, payload[:3], b"", memoryview(payload)[3:])
        received = there.receive()
        here.close()
        there.close()

        assert plain(received) == messages

    def test_half_a_message_is_none_yet(self, ends):
        channel, peer = ends
        text = frame({"do": "stop"})
        peer.sendall(text[:15])
        assert channel.receive() == []
        assert channel.next(0.0) is None

        peer.sendall(text[15:])
        assert channel.next(0.0) == {"do": "stop"}

    def test_messages_that_came_together_are_taken_one_by_one(self, ends):
        channel, peer = ends
        peer.sendall(frame({"number": 1}) + frame({"number": 2}) + frame({"number": 3}))

        assert channel.next(PATIENCE_S) == {"number": 1}
        assert channel.next(PATIENCE_S) == {"number": 2}
        assert channel.receive(PATIENCE_S) == [{"number": 3}]

    def test_what_a_peer_said_before_it_died_is_heard(self, ends):
        channel, peer = ends
        peer.sendall(frame({"event": "stopped"}) + b"\x05\0")
        peer.close()

        assert channel.next(0.0) == {"event": "stopped"}
        assert channel.next(None) is None
        assert channel.closed
        assert channel.receive(None) == []

    def test_sending_to_a_dead_peer_raises_nothing(self, ends):
        channel, peer = ends
        peer.close()
        channel.send({"event": "ready"}, b"x")

        assert channel.closed
        assert not channel.flush()

    def test_a_peer_that_does_not_read_holds_nothing_up_and_misses_nothing(self, ends):
        channel, peer = ends
        reader = Channel(peer)
        sent = [({"number": number, "text": "x" * 10_000}, bytes([number]) * 5000 * number) for number in range(100)]
        for message, payload in sent:
            channel.send(message, payload)
        assert channel.backlog > 0
        assert not channel.flush(0.0)

        received = reader.receive()
        while len(received) < len(sent):
            channel.receive()
            received += reader.receive()
        reader.close()
        assert plain(received) == sent
        assert channel.backlog == 0

    def test_bytes_that_another_thread_sends_go_on_while_one_waits(self, ends):
        """Without the wake, what does not fit into the socket would lie until the next message came."""
        channel, peer = ends
        reader, sizes = Channel(peer), list[int]()

        def receive() -> None:
            while not channel.closed:
                channel.receive(None)

        waiting = threading.Thread(target=receive, daemon=True)
        waiting.start()
        for _ in range(3):
            channel.send({"event": "picture"}, bytes(4_000_000))
            message = reader.next(PATIENCE_S)
            assert message is not None
            sizes.append(len(message.payload))
        reader.close()
        waiting.join()
        assert sizes == 3 * [4_000_000]

    def test_waiting_ends_by_wake(self, ends):
        channel, _ = ends
        channel.wake()
        assert channel.receive(None) == []

    def test_one_that_never_reads_is_disconnected_in_the_end(self, ends, monkeypatch):
        monkeypatch.setattr("ibrobot_core.channel._LARGEST", 1_000_000)
        channel, _ = ends
        for _ in range(100):
            channel.send({"event": "picture"}, bytes(100_000))
        assert channel.closed
        assert channel.backlog < 2_000_000


class TestStrangers:
    """A peer may send anything: what is no message of the protocol is dropped, and the next message arrives."""

    @given(content=st.dictionaries(KEYS | st.text(), VALUES, max_size=5))
    def test_nothing_in_a_message_passes_for_a_report(self, content):
        sender, receiver = map(Channel, socket.socketpair())
        sender.send(content)
        received = receiver.receive()
        sender.close()
        receiver.close()

        assert json.dumps(received) == json.dumps([content])
        assert [message.word for message in received] == ["message"]
        assert receiver.dropped == 0

    @given(
        wrong=st.one_of(
            st.binary(min_size=1, max_size=60).map(framed),
            VALUES.map(lambda value: framed(json.dumps(value).encode())),
            st.builds(frame, VALUES, VALUES),
            st.builds(frame, st.dictionaries(KEYS, VALUES), st.sampled_from(["log", "failure", "message"])),
            st.sampled_from([b"[" * 100_000, b"\xff\xfe\n", b"1" * 5000]).map(framed),
        )
    )
    def test_what_is_no_message_is_dropped(self, wrong):
        ours, theirs = socket.socketpair()
        channel = Channel(ours)
        theirs.sendall(wrong + frame({"event": "ready"}))
        received = channel.receive()
        channel.close()
        theirs.close()

        assert received[-1] == {"event": "ready"}
        assert all(isinstance(message, dict) and isinstance(message.word, str) for message in received)
        assert len(received) - 1 + channel.dropped == 1

    @pytest.mark.parametrize(
        "text", [b'["message", [["do", "estop"]]]', b'[["message"], {"do": "estop"}]', b'["message"]']
    )
    def test_a_message_is_a_word_and_an_object(self, ends, text):
        channel, peer = ends
        peer.sendall(framed(text))
        assert channel.receive() == []
        assert channel.dropped == 1

    @given(
        messages=MESSAGES,
        places=st.lists(st.tuples(st.integers(0, 2000), st.integers(1, 255)), min_size=1, max_size=4),
        end=st.none() | st.integers(0, 2000),
    )
    @example(messages=[({}, b"")], places=[(3, 255)], end=None)
    def test_a_damaged_stream_raises_nothing_and_spares_what_came_before(self, messages, places, end):
        frames = [frame(message, payload=payload) for message, payload in messages]
        stream = bytearray(b"".join(frames))[:end]
        for place, change in places:
            if place < len(stream):
                stream[place] ^= change
        first = min([len(stream), *(place for place, _ in places)])
        whole = [i for i in range(len(frames)) if sum(map(len, frames[: i + 1])) <= first]
        ours, theirs = socket.socketpair()
        channel = Channel(ours)
        theirs.sendall(stream)
        theirs.close()
        received = channel.receive()
        channel.close()

        assert plain(received)[: len(whole)] == [messages[i] for i in whole]
        assert all(isinstance(message, dict) for message in received)

    @given(text=st.integers(0, 2**32 - 1), payload=st.integers(0, 2**32 - 1))
    def test_a_frame_that_is_too_large_ends_the_connection_before_it_takes_memory(self, text, payload):
        ours, theirs = socket.socketpair()
        channel = Channel(ours)
        theirs.sendall(struct.pack("<II", text, payload))
        channel.receive()
        closed, held = channel.closed, len(channel._room)
        channel.close()
        theirs.close()

        assert closed == (text == 0 or text > 64 << 20 or payload > 256 << 20)
        assert held <= (320 << 20)


def test_an_interpreter_that_lacks_everything_else_can_use_it():
    """As that of a ROS of 2022 does, with Python 3.10 and without ibrobot's packages."""
    path = Path(ibrobot_core.channel.__file__)
    ast.parse(path.read_text(encoding="utf-8"), feature_version=(3, 10))
    code = (
        "import sys, types, socket\n"
        "package = sys.modules['ibrobot_core'] = types.ModuleType('ibrobot_core')\n"
        f"package.__path__ = [{str(path.parent)!r}]\n"
        "from ibrobot_core.channel import Channel\n"
        "here, there = map(Channel, socket.socketpair())\n"
        "here.send({'event': 'ready'}, b'payload')\n"
        "message = there.next(10.0)\n"
        "print(message, bytes(message.payload))\n"
    )
    done = subprocess.run([sys.executable, "-I", "-S", "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout == "{'event': 'ready'} b'payload'\n", done.stderr

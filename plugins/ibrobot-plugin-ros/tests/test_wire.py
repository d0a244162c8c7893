"""Frames over the socket between a run and its node."""

from __future__ import annotations

import os
import socket
import struct
from typing import Any

import pytest
from ibrobot_ros.wire import Wire


@pytest.fixture
def wires():
    ends = [Wire(end) for end in socket.socketpair()]
    yield ends
    for end in ends:
        end.close()


def test_frames_arrive_in_order(wires):
    here, there = wires
    for i in range(100):
        here.send({"op": "message", "number": i}, bytes([i]) * i)
    got: list[Any] = []
    while len(got) < 100:
        got += there.wait(1.0)
    assert [head["number"] for head, _ in got] == list(range(100))
    assert [body for _, body in got] == [bytes([i]) * i for i in range(100)]


def test_sending_never_waits_for_a_reader(wires):
    here, there = wires
    picture = os.urandom(1_000_000)
    for _ in range(8):
        here.send({"op": "message"}, picture)
    assert here.backlog > 4_000_000
    assert not here.flush(0.0)
    got: list[Any] = []
    while len(got) < 8:
        here.wait(0.0)
        got += there.wait(0.01)
    assert all(body == picture for _, body in got)
    assert here.backlog == 0


def test_a_dead_reader_raises_nothing(wires):
    here, there = wires
    there.close()
    here.send({"op": "message"}, b"x")
    here.wait(0.1)
    assert here.closed
    assert here.wait(0.0) == []


def test_a_frame_that_is_too_long_ends_the_connection():
    one, other = socket.socketpair()
    here = Wire(one)
    with other:
        other.sendall(struct.pack("<II", 1 << 30, 0))
        assert here.wait(1.0) == []
        assert here.closed
    here.close()


def test_waiting_ends_by_wake(wires):
    wires[0].wake()
    assert wires[0].wait(60.0) == []

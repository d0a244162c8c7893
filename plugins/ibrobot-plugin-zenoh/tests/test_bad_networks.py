"""Servers that die and come back, links that come late, floods, messages that are too large."""

from __future__ import annotations

import queue
import socket
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
from ibrobot_ros2.workers import StopWay
from ibrobot_testing.section import make_session
from ibrobot_zenoh import connection as connection_module
from ibrobot_zenoh import transport as transport_module

from ibrobot_core.api import Payload, TransportError

from .pair import WAIT_S, client, free_endpoint, router, settle, wait_for


@pytest.fixture
def serving() -> object:
    """Starts a process that serves `echo` at an endpoint; those that a test leaves are killed."""
    started: list[subprocess.Popen[str]] = []

    def start(endpoint: str) -> subprocess.Popen[str]:
        script = Path(__file__).with_name("serving_process.py")
        process = subprocess.Popen(
            [sys.executable, str(script), endpoint], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        started.append(process)
        assert process.stdout is not None
        assert process.stdout.readline() == "serving\n"
        return process

    yield start
    for process in started:
        process.kill()
        process.communicate()


def test_a_killed_server_is_missed_and_used_again(serving: Callable[[str], subprocess.Popen[str]]):
    endpoint = free_endpoint()
    robot = client(endpoint)
    states: queue.SimpleQueue[bool] = queue.SimpleQueue()
    robot.watch("echo", states.put)
    assert states.get_nowait() is False
    for _ in range(2):
        process = serving(endpoint)
        assert states.get(timeout=WAIT_S) is True
        assert robot.request("echo", b"hello", WAIT_S) == b"hello"
        failures: queue.SimpleQueue[str] = queue.SimpleQueue()

        def ask(failures: queue.SimpleQueue[str] = failures) -> None:
            with pytest.raises(TransportError) as failed:
                robot.request("echo", b"hang", WAIT_S)
            failures.put(str(failed.value))

        asking = threading.Thread(target=ask)
        asking.start()
        assert process.stdout is not None
        assert process.stdout.readline() == "asked\n"
        process.kill()
        assert states.get(timeout=WAIT_S) is False
        asking.join(WAIT_S)
        assert failures.get(timeout=WAIT_S) == "nobody serves echo, or not any more"
        with pytest.raises(TransportError, match="nobody serves echo"):
            robot.request("echo", b"hello", WAIT_S)
    robot.close()


def test_a_client_may_come_before_its_router(caplog: pytest.LogCaptureFixture):
    """What it declared meanwhile is there as soon as the router is."""
    endpoint = free_endpoint()
    early = client(endpoint)
    with pytest.raises(TransportError, match=f"not connected: {endpoint}: nobody listens there"):
        early.request("echo", b"", WAIT_S)
    early.publish("topic", b"nobody hears this")
    arrived: queue.SimpleQueue[object] = queue.SimpleQueue()
    early.subscribe("topic", arrived.put)
    end_ended = early.subscribe("topic", lambda payload: arrived.put("ended"))
    early.serve("echo", lambda payload, _: payload)
    end_ended()
    far = router(endpoint)
    known = threading.Event()
    far.watch("echo", lambda served: known.set() if served else None)
    assert known.wait(WAIT_S)
    assert far.request("echo", b"x", WAIT_S) == b"x"
    settle(far, early)
    far.publish("topic", b"y")
    assert arrived.get(timeout=WAIT_S) == b"y"
    early.close()
    far.close()
    assert arrived.empty()


def test_a_client_that_never_connected_can_be_closed():
    lonely = client(free_endpoint())
    lonely.subscribe("topic", lambda payload: None)
    lonely.close()


PROGRAM = """
import sys
from ibrobot_testing import host_context
from ibrobot_zenoh.options import ZenohOptions
from ibrobot_zenoh.transport import ZenohTransport

far = ZenohTransport(ZenohOptions(mode="router", listen=(sys.argv[1],)), host_context())
near = ZenohTransport(ZenohOptions(connect=(sys.argv[1],)), host_context())
near.subscribe("a", print)
far.serve("b", print)
near.watch("b", str)
if sys.argv[2] == "close":
    near.close()
    far.close()
raise SystemExit(3)
"""


@pytest.mark.parametrize("how", ["close", "forget"])
def test_a_process_ends_also_when_nothing_was_closed(how: str):
    command = [sys.executable, "-c", PROGRAM, free_endpoint(), how]
    ended = subprocess.run(command, timeout=3 * WAIT_S, check=False, capture_output=True)
    if how == "close":
        assert (ended.returncode, ended.stderr) == (3, b"")
    else:  # it does not hang; Zenoh's threads may abort it on its way out
        assert ended.returncode != 0


def test_an_address_that_is_taken():
    endpoint = free_endpoint()
    first = router(endpoint)
    with pytest.raises(TransportError, match=endpoint):
        router(endpoint)
    first.close()


def test_large_messages_are_refused_both_ways():
    endpoint = free_endpoint()
    server = router(endpoint, max_message_size=100_000)
    server.serve("twice", lambda payload, _: bytes(payload) * 2)
    strict, lax = client(endpoint, max_message_size=100_000), client(endpoint)
    settle(lax, server)
    with pytest.raises(TransportError, match="a message of 100001 bytes is larger than max_message_size, 100000"):
        strict.request("twice", bytes(100_001), WAIT_S)
    with pytest.raises(TransportError, match="larger than max_message_size"):
        strict.publish("topic", bytes(100_001))
    with pytest.raises(TransportError, match=r"twice failed: .*a message of 160000 bytes is larger"):
        lax.request("twice", bytes(80_000), WAIT_S)
    with pytest.raises(TransportError, match="no answer"):  # a sender without the limit is cut off by the receiver
        lax.request("twice", bytes(1_000_000), 0.2)
    assert len(lax.request("twice", bytes(50_000), WAIT_S)) == 100_000
    for end in (strict, lax, server):
        end.close()


def test_connections_that_say_nothing_keep_nobody_out(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(connection_module, "_ACCEPT_MS", 3_600_000)
    endpoint = free_endpoint()
    server = router(endpoint)
    server.serve("echo", lambda payload, _: payload)
    host, _, port = endpoint.removeprefix("tcp/").rpartition(":")
    silent = [socket.create_connection((host, int(port)), timeout=WAIT_S) for _ in range(300)]
    try:
        robot = client(endpoint)
        settle(robot, server)
        assert robot.request("echo", b"hello", WAIT_S) == b"hello"
        robot.close()
    finally:
        for each in silent:
            each.close()
        server.close()


def test_without_further_threads_stops_are_answered_and_others_refused(monkeypatch: pytest.MonkeyPatch):
    endpoint = free_endpoint()
    server, robot = router(endpoint), client(endpoint)
    way = StopWay(make_session(), "the test")
    server.serve_with_urgent("services", lambda payload, *_: b"done", lambda payload: payload == b"stop", 1000, way)
    settle(robot, server)
    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", _refuse)
        for _ in range(5):
            with pytest.raises(TransportError, match="services failed: it is overloaded, has no thread for it"):
                robot.request("services", b"other", WAIT_S)
            assert robot.request("services", b"stop", WAIT_S) == b"done"
    assert robot.request("services", b"other", WAIT_S) == b"done", "threads start again"


def _refuse(thread: threading.Thread) -> None:
    raise RuntimeError("can't start new thread")


def test_a_request_that_cannot_be_read_ends_the_run():
    endpoint = free_endpoint()
    server, robot = router(endpoint), client(endpoint)
    session = make_session()

    def is_urgent(payload: Payload) -> bool:
        raise MemoryError

    server.serve_with_urgent("services", lambda payload, *_: b"done", is_urgent, 1000, StopWay(session, "the test"))
    settle(robot, server)
    with pytest.raises(TransportError):
        robot.request("services", b"stop", 1.0)
    assert session.finished.wait(WAIT_S)
    assert session.failure is not None
    assert session.failure[0] == "the test"


def test_urgent_requests_wait_for_no_others(monkeypatch: pytest.MonkeyPatch):
    """A stop is answered while a flood keeps every thread busy and fills the queue."""
    monkeypatch.setattr(transport_module.ZenohTransport, "handler_threads", 2)
    monkeypatch.setattr(transport_module, "REQUESTS_WAITING", 2)
    endpoint = free_endpoint()
    server, robot = router(endpoint), client(endpoint)
    release, busy = threading.Event(), threading.Semaphore(0)

    def answer(payload: Payload, *_: object) -> bytes:
        if payload != b"stop":
            busy.release()
            release.wait()
        return b"done"

    way = StopWay(make_session(), "the test")
    server.serve_with_urgent("services", answer, lambda payload: payload == b"stop", 1000, way)
    settle(robot, server)
    outcomes: queue.SimpleQueue[str] = queue.SimpleQueue()

    def ask() -> None:
        try:
            outcomes.put(bytes(robot.request("services", b"", WAIT_S)).decode())
        except TransportError as error:
            outcomes.put(str(error))

    asking = [threading.Thread(target=ask) for _ in range(8)]
    for thread in asking:
        thread.start()
    for _ in range(2):
        assert busy.acquire(timeout=WAIT_S)
    try:
        for _ in range(20):
            assert robot.request("services", b"stop", WAIT_S) == b"done"
        with pytest.raises(TransportError, match="services failed: a request of 1001 bytes, at most 1000 are read"):
            robot.request("services", bytes(1001), WAIT_S)
    finally:
        release.set()
    told = [outcomes.get(timeout=WAIT_S) for _ in asking]
    assert any("overloaded" in each for each in told), "the flood was one"
    for thread in asking:
        thread.join()
    robot.close()
    server.close()


def test_a_flood_is_turned_away(monkeypatch: pytest.MonkeyPatch):
    """The queue of a server is bounded; a refused client gets an answer, and so do the others."""
    monkeypatch.setattr(transport_module, "REQUESTS_WAITING", 2)
    endpoint = free_endpoint()
    server, robot = router(endpoint), client(endpoint)
    release, begun = threading.Event(), threading.Event()

    def slow(payload: object, _: object) -> bytes:
        begun.set()
        release.wait(WAIT_S)
        return b"done"

    server.serve("slow", slow, workers=1)
    settle(robot, server)
    outcomes: queue.SimpleQueue[str] = queue.SimpleQueue()

    def ask() -> None:
        try:
            outcomes.put(bytes(robot.request("slow", b"", WAIT_S)).decode())
        except TransportError as error:
            outcomes.put(str(error))

    asking = [threading.Thread(target=ask) for _ in range(6)]
    asking[0].start()
    assert begun.wait(WAIT_S)
    for thread in asking[1:]:
        thread.start()
    assert [outcomes.get(timeout=WAIT_S) for _ in range(3)] == [
        "slow failed: it is overloaded, has no thread for it, or is about to end"
    ] * 3
    release.set()
    assert [outcomes.get(timeout=WAIT_S) for _ in range(3)] == ["done"] * 3
    for thread in asking:
        thread.join()
    robot.close()
    server.close()


def test_a_slow_subscriber_loses_the_oldest(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture):
    monkeypatch.setattr(transport_module, "SUBSCRIBER_DEPTH", 3)
    endpoint = free_endpoint()
    far, near = router(endpoint), client(endpoint)
    release, begun = threading.Event(), threading.Event()
    arrived: list[object] = []

    def slow(payload: object) -> None:
        begun.set()
        release.wait(WAIT_S)
        arrived.append(payload)

    far.subscribe("topic", slow)
    settle(near, far)
    near.publish("topic", b"0")
    assert begun.wait(WAIT_S)
    for i in range(1, 7):
        near.publish("topic", str(i).encode())
    settle(near, far)
    release.set()
    wait_for(lambda: len(arrived) == 4)
    assert arrived == [b"0", b"4", b"5", b"6"]
    assert "a subscriber of topic is too slow" in caplog.text
    near.close()
    far.close()


@pytest.mark.parametrize("name", ["a*", "a//b", "", "a?b", "a#b", "$*"])
def test_names_that_cannot_be(name: str):
    transport = router(free_endpoint())
    with pytest.raises(TransportError, match="cannot be a name here"):
        transport.request(name, b"", WAIT_S)
    transport.close()

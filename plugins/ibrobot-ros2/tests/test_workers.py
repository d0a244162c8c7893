"""Workers: order, the bound on threads and on what waits, contained exceptions, the end."""

from __future__ import annotations

import queue
import threading
import time
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ibrobot_ros2.workers import StopWay, Workers
from ibrobot_testing import make_session

from ibrobot_core.api import TransportError
from ibrobot_core.app import Session

PATIENCE_S = 30.0


def test_one_worker_keeps_the_order():
    done: queue.SimpleQueue[int] = queue.SimpleQueue()
    workers = Workers(done.put, "numbers")
    for i in range(100):
        assert workers.put(i) is None
    assert [done.get(timeout=PATIENCE_S) for _ in range(100)] == list(range(100))
    workers.end()


def test_threads_start_when_needed_and_no_more_than_allowed():
    begun: queue.SimpleQueue[Any] = queue.SimpleQueue()
    release = threading.Event()

    def work(item):
        begun.put(threading.current_thread())
        release.wait(PATIENCE_S)

    workers = Workers(work, "busy", count=2)
    for i in range(3):
        workers.put(i)
    assert begun.get(timeout=PATIENCE_S) is not begun.get(timeout=PATIENCE_S)
    with pytest.raises(queue.Empty):
        begun.get(timeout=0.02)
    release.set()
    begun.get(timeout=PATIENCE_S)
    workers.end()


def test_the_oldest_gives_way():
    begun: queue.SimpleQueue[Any] = queue.SimpleQueue()
    release = threading.Event()

    def work(item):
        begun.put(item)
        release.wait(PATIENCE_S)

    workers = Workers(work, "slow", depth=2)
    workers.put("a")
    assert begun.get(timeout=PATIENCE_S) == "a"
    assert [workers.put(item) for item in "bcde"] == [None, None, "b", "c"]
    release.set()
    assert [begun.get(timeout=PATIENCE_S) for _ in range(2)] == ["d", "e"]
    workers.end()


def test_an_exception_is_logged_and_the_next_item_worked_on(caplog: pytest.LogCaptureFixture):
    done: queue.SimpleQueue[int] = queue.SimpleQueue()

    def work(item):
        if item == 1:
            raise ValueError("one is bad")
        done.put(item)

    workers = Workers(work, "the picky one")
    workers.put(1)
    workers.put(2)
    assert done.get(timeout=PATIENCE_S) == 2
    workers.end()
    assert "the picky one failed" in caplog.text
    assert "one is bad" in caplog.text


def test_after_the_end_nothing_is_begun():
    done: queue.SimpleQueue[int] = queue.SimpleQueue()
    workers = Workers(done.put, "ended")
    workers.end()
    workers.end()
    assert workers.put(1) == 1
    assert done.empty()


class Starts:
    """Lets threads start, or refuses it as a system at its limit does."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.refused = 0
        self.left: float = float("inf")
        start = threading.Thread.start

        def limited(thread: threading.Thread) -> None:
            if self.left < 1:
                self.refused += 1
                raise RuntimeError("can't start new thread")
            self.left -= 1
            start(thread)

        monkeypatch.setattr(threading.Thread, "start", limited)


@pytest.fixture
def starts(monkeypatch: pytest.MonkeyPatch) -> Starts:
    return Starts(monkeypatch)


def test_an_item_without_a_thread_is_refused_and_the_next_one_tries_again(starts: Starts):
    done: queue.SimpleQueue[int] = queue.SimpleQueue()
    workers = Workers(done.put, "short of threads", count=4)
    starts.left = 0
    assert [workers.put(i) for i in (1, 2)] == [1, 2]
    starts.left = 1
    assert workers.put(3) is None
    assert done.get(timeout=PATIENCE_S) == 3
    starts.left = 0
    assert workers.put(4) is None, "the thread that could start goes on"
    assert done.get(timeout=PATIENCE_S) == 4
    workers.end()


def test_a_busy_thread_keeps_no_item_that_another_one_cannot_take(starts: Starts):
    begun: queue.SimpleQueue[Any] = queue.SimpleQueue()
    release = threading.Event()

    def work(item):
        begun.put(item)
        release.wait(PATIENCE_S)

    workers = Workers(work, "busy", count=2)
    workers.put("a")
    assert begun.get(timeout=PATIENCE_S) == "a"
    starts.left = 0
    assert workers.put("b") == "b"
    starts.left = 1
    assert workers.put("c") is None
    assert begun.get(timeout=PATIENCE_S) == "c"
    release.set()
    workers.end()


@given(st.lists(st.booleans(), min_size=1, max_size=12), st.integers(1, 4))
@settings(max_examples=300, deadline=None)
def test_every_item_is_done_or_refused_whichever_starts_fail(permits: list[bool], count: int):
    done: queue.SimpleQueue[int] = queue.SimpleQueue()
    with pytest.MonkeyPatch.context() as patch:
        starts = Starts(patch)
        workers = Workers(done.put, "short of threads", count=count)
        accepted = []
        for i, permitted in enumerate(permits):
            starts.left = 1 if permitted else 0
            if workers.put(i) is None:
                accepted.append(i)
        assert sorted(done.get(timeout=PATIENCE_S) for _ in accepted) == accepted
        workers.end()


@pytest.fixture
def session() -> Session:
    session = make_session()
    session.control = RecordingControl()  # type: ignore[assignment]
    return session


class RecordingControl:
    """What a run sends to control."""

    running = True
    stops = 0

    def __init__(self) -> None:
        self.calls: list[str] = []

    def call(self, command: Any) -> dict[str, Any]:
        self.calls.append(type(command).__name__)
        return {}


def test_threads_of_stops_exist_from_the_start(session: Session, starts: Starts):
    done: queue.SimpleQueue[int] = queue.SimpleQueue()
    workers = Workers(done.put, "stops", count=2, way=StopWay(session, "stops"))
    starts.left = 0
    assert [workers.put(i) for i in range(5)] == [None] * 5
    assert sorted(done.get(timeout=PATIENCE_S) for _ in range(5)) == list(range(5))
    assert starts.refused == 0
    workers.end()


@pytest.mark.parametrize("left", [0, 1])
def test_without_threads_for_stops_there_is_no_run(session: Session, starts: Starts, left: int):
    starts.left = left
    with pytest.raises(TransportError, match="stops: its threads cannot start"):
        Workers(print, "stops", count=2, way=StopWay(session, "stops"))


@pytest.mark.parametrize("error", [MemoryError(), ValueError("a bug"), SystemExit()])
def test_a_stop_that_fails_stops_the_robot_and_ends_the_run(session: Session, error: BaseException):
    def work(item: int) -> None:
        raise error

    workers = Workers(work, "stops", way=StopWay(session, "services"))
    workers.put(1)
    assert session.finished.wait(PATIENCE_S)
    assert session.failure is not None
    assert session.failure[0] == "services"
    assert session.control.calls == ["EmergencyStop"]  # type: ignore[attr-defined]
    workers.end()


def test_idle_threads_of_stops_give_signs_of_life(session: Session):
    way = StopWay(session, "services")
    way.open()
    (pulse,) = session.pulses
    workers = Workers(print, "stops", way=way)
    for _ in range(3):
        before, deadline = pulse._beats, time.monotonic() + PATIENCE_S
        while pulse._beats == before:
            assert time.monotonic() < deadline
            time.sleep(0.005)
    workers.end()
    way.close()
    assert not session.pulses

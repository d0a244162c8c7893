"""Workers: order, the bound on threads and on what waits, contained exceptions, the end."""

from __future__ import annotations

import queue
import threading
from typing import Any

import pytest
from ibrobot_zenoh.workers import Workers

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

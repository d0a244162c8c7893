"""The end of an episode that does not fit into the queue, or that the disk refuses, makes its outcome unknown."""

from __future__ import annotations

import random
import threading
from collections import Counter
from typing import Any, cast

import attrs
import pytest
from ibrobot_mcap import output
from ibrobot_mcap.bagfile import Item
from ibrobot_mcap.metadata import STATED, Topic
from ibrobot_mcap.storage import Storage
from ibrobot_mcap.thread import WriterThread

from ibrobot_core.api import RecorderError

from .conftest import CAMERA, JOINTS, picture, read, summary

MIB = 1 << 20
QUEUES = 300
"""Number of generated queues."""
_LONG_S = 60.0


def stall(monkeypatch: pytest.MonkeyPatch) -> tuple[threading.Event, threading.Event]:
    """Let the disk take nothing: events that say that it was asked, and that let it go on."""
    stuck, go_on, write = threading.Event(), threading.Event(), output.Output.write

    def slowly(self: output.Output, data: bytes) -> int:
        stuck.set()
        assert go_on.wait(_LONG_S)
        return write(self, data)

    monkeypatch.setattr(output.Output, "write", slowly)
    return stuck, go_on


def test_an_episode_whose_end_did_not_fit_into_the_queue_is_unknown(bench, monkeypatch):
    made = bench(threaded=True, queue_size=MIB, chunk_size=1024)
    made.begin(topics=(JOINTS, CAMERA))
    stuck, go_on = stall(monkeypatch)
    made.write(1, CAMERA, picture)
    assert stuck.wait(_LONG_S)
    offered = 2 * MIB // picture(0).data.nbytes
    made.write(offered, CAMERA, picture, start=1)
    lost = made.recorder.lost()
    assert lost[CAMERA] > 0, "seen while it runs"
    go_on.set()
    path = made.end()
    kept = summary(path)
    assert (kept.finished, kept.outcome, kept.metadata[STATED]) == (True, "unknown", "success")
    assert kept.topics[CAMERA].dropped == lost[CAMERA]
    assert made.recorder.lost() == {}


def test_an_episode_that_lost_messages_before_its_end_keeps_its_outcome(bench, monkeypatch):
    made = bench(threaded=True, queue_size=MIB, chunk_size=1024)
    made.begin(topics=(JOINTS, CAMERA))
    stuck, go_on = stall(monkeypatch)
    made.write(1, CAMERA, picture)
    assert stuck.wait(_LONG_S)
    offered = 2 * MIB // picture(0).data.nbytes
    made.write(offered, CAMERA, picture, start=1)
    go_on.set()
    pause = threading.Event()
    while made.recorder.waiting():
        pause.wait(0.001)
    made.write(1, CAMERA, picture, start=offered + 1)
    kept = summary(made.end())
    assert (kept.outcome, STATED in kept.metadata) == ("success", False)
    assert kept.topics[CAMERA].dropped > 0


def test_an_episode_whose_end_the_full_disk_refused_is_unknown(bench, monkeypatch):
    """No message came after the disk was full, so that nobody was told of it but `end`."""
    made = bench(threaded=True)
    made.begin(topics=(JOINTS,))
    go_on, write = threading.Event(), Storage.write

    def refuse(self: Storage, item: Item) -> None:
        assert go_on.wait(_LONG_S)
        if len(self._topics) and sum(self._topics.values()) == 5:
            raise RecorderError("its disk has 1 MiB left")
        write(self, item)

    monkeypatch.setattr(Storage, "write", refuse)
    made.write(8)
    go_on.set()
    path = made.end()
    kept = summary(path)
    assert (kept.outcome, kept.metadata[STATED]) == ("unknown", "success")
    assert (kept.topics[JOINTS].count, kept.topics[JOINTS].dropped, len(read(path))) == (5, 3, 5)


@attrs.define(eq=False)
class Gate:
    """A storage that takes as many items as it is allowed to, and refuses the `full`-th; a bug if `broken`."""

    full: int | None = None
    broken: bool = False
    allowed: int = 0
    written: list[tuple[str, int]] = attrs.field(factory=list)
    changed: threading.Condition = attrs.field(factory=threading.Condition)

    def write(self, item: Item) -> None:
        with self.changed:
            assert self.changed.wait_for(lambda: len(self.written) < self.allowed, _LONG_S)
            if len(self.written) == self.full:
                raise KeyError("full") if self.broken else RecorderError("full")
            self.written.append((item.topic.name, item.received_ns))
            self.changed.notify_all()

    def allow(self, count: int) -> None:
        with self.changed:
            self.allowed += count
            self.changed.notify_all()

    def due_in_s(self) -> None:
        return None

    def flush_due(self) -> None:
        pass


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_losses_anywhere_are_counted_and_the_newest_are_known(monkeypatch):
    """Also those in the hands of a thread that a full disk or a bug has ended."""
    monkeypatch.setattr(threading, "excepthook", lambda *_: None)
    seen = Counter[str]()
    for seed in range(QUEUES):
        draw = random.Random(seed)
        gate = Gate(draw.choice([None, None, draw.randint(0, 12)]), draw.random() < 0.3)
        thread = WriterThread(cast(Storage, cast(Any, gate)), draw.randint(1, 6) * 300)
        offered = list[tuple[str, int]]()
        for number in range(draw.randint(0, 25)):
            topic = f"/{draw.choice('aab')}"
            offered.append((topic, number))
            try:
                thread.put(Item(Topic(topic, "T", latched=False), memoryview(bytes(44)), number, number))
            except RecorderError:
                offered.pop()
                break
            if draw.random() < 0.3:
                gate.allow(draw.randint(1, 3))
        gate.allow(100)
        failure = thread.stop()
        lost = Counter(topic for topic, _ in offered) - Counter(topic for topic, _ in gate.written)
        cut = {topic for topic, newest in dict(offered).items() if dict(gate.written).get(topic) != newest}
        assert (thread.dropped, thread.cut, thread.size) == (lost, cut, 0), (seed, offered, gate)
        assert failure is None or gate.full is not None
        seen["cut" if cut else "lossy" if lost else "whole"] += 1
    assert min(seen.values()) > QUEUES // 20, seen

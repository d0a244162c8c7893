# mypy: disable-error-code="func-returns-value,assignment,unused-ignore"
"""A disk that stalls, and messages that are lost: what the run says of an episode is what is on the disk."""

from __future__ import annotations

import queue
import random
import threading
from collections import Counter
from collections.abc import Iterator
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import attrs
import pytest
from ibrobot_data import recording_worker as recording
from ibrobot_data.operator import Operator
from ibrobot_data.recording_worker import RecordingWorker

from ibrobot_core.api import EpisodeEnd, EpisodeStart, SteppedClock, String
from ibrobot_core.app import ComponentFailed, SessionWorker

if TYPE_CHECKING:
    from fake_runs import Runs

    from ibrobot_core.app import Runtime

STALLS, LOSSES = 60, 200
"""Number of generated disks, and of generated queues."""
_HUNG_S = 60


@attrs.define(eq=False)
class Disk:
    """A recorder whose calls take as long as it is told, on a clock that only the end of the run moves [s]."""

    stalls: dict[int, float]
    """Number of the call, from 0 -> how long it takes [s]."""
    now: float = 0.0
    calls: int = 0
    blocked: bool = False
    released: bool = False
    size: int = 0
    ended: list[EpisodeEnd] = attrs.field(factory=list)
    changed: threading.Condition = attrs.field(factory=threading.Condition)

    def take(self) -> None:
        with self.changed:
            until = self.now + self.stalls.get(self.calls, 0.0)
            self.calls += 1
            self.blocked = until > self.now
            self.changed.notify_all()
            assert self.changed.wait_for(lambda: self.now >= until or self.released, _HUNG_S)
            self.blocked = False

    def begin(self, episode: EpisodeStart) -> None:
        episode.directory.mkdir()

    def write(self, topic: str, message: object, received_ns: int) -> None:
        self.take()
        self.size -= 1

    def end(self, episode: EpisodeEnd) -> None:
        self.take()
        self.ended.append(episode)

    def waiting(self) -> int:
        return self.size

    def pause(self, worker: RecordingWorker, wait_s: float) -> None:
        """Let time pass, once the recorder's thread has done what it can do by now."""
        with self.changed:
            for _ in range(1000 * _HUNG_S):
                if self.blocked or not worker.writing:
                    break
                self.changed.wait(0.001)
            self.now += 5.0
            self.changed.notify_all()
            if self.blocked:  # it may go on
                self.changed.wait(0.001)

    def release(self) -> None:
        with self.changed:
            self.released = True
            self.changed.notify_all()


def slow(runs: Runs, monkeypatch: pytest.MonkeyPatch, stalls: dict[int, float], **asked: Any) -> Any:
    """A run in real time whose recording has begun, and nothing else."""
    runtime = runs.make(
        "recording={type: lines, topics: all}", mode="teleop", lockstep=False, by_operator=True, **asked
    )
    (worker,) = (each for each in runtime.plan.components if isinstance(each, RecordingWorker))
    run = SimpleNamespace(runtime=runtime, worker=worker)
    with_disk(run, monkeypatch, stalls)
    return run


def with_disk(run: Any, monkeypatch: pytest.MonkeyPatch, stalls: dict[int, float]) -> None:
    """Begin the recording, onto another disk."""
    disk = run.disk = Disk(stalls)
    monkeypatch.setattr(recording, "time", SimpleNamespace(monotonic=lambda: disk.now))
    monkeypatch.setattr(run.worker, "pause", lambda wait_s: disk.pause(run.worker, wait_s))
    run.worker.start()
    for name in ("begin", "write", "end", "waiting"):
        monkeypatch.setattr(run.worker.recorder, name, getattr(disk, name))


def hangs(worker: Any) -> None:
    """What `SessionWorker.stop` does after seconds, at once."""
    worker._end.set()
    raise ComponentFailed(f"{worker.name} hangs: still working 5 s after the stop")


def record(run: Any, episodes: int, messages: int) -> None:
    """Record episodes of as many messages."""
    for number in range(1, episodes + 1):
        run.worker.begin(number, "pick")
        for _ in range(messages):
            run.runtime.session.bus.publish("/note", String("x"))
        run.disk.size += messages
        run.worker.end("success")


def summary(run: Any, wanted: int) -> dict[str, str]:
    service = run.runtime.session.episodes
    operator = Operator(run.runtime.session, service, wanted, 0.0, "pick", auto=True, keys=False)
    return dict(operator.summary_rows())


@pytest.fixture
def stopped() -> Iterator[list[Any]]:
    """Runs whose disks are released at the end."""
    made: list[Any] = []
    yield made
    for run in made:
        free(run)


def free(run: Any) -> None:
    """Let the disk take everything, and the recorder's thread end."""
    run.disk.release()
    if run.worker._thread is not None:
        run.worker._thread.join(_HUNG_S)


def test_the_end_of_a_run_waits_for_a_disk_that_stalls(
    runs: Runs, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    run = slow(runs, monkeypatch, {2: 25.0, 5: 25.0})
    record(run, 1, 5)
    run.worker.stop()
    assert run.disk.calls == 6
    assert summary(run, 1)["recorded"].startswith("1 of 1 episode")
    assert run.runtime.session.outcome.faults == []
    assert "still writing the recording, for 5 s; 0.0 MiB are left, nothing was written for" in caplog.text
    assert "Ctrl-C, pressed twice, gives up" in caplog.text


def test_an_episode_that_the_disk_does_not_take_is_not_recorded(
    runs: Runs, monkeypatch: pytest.MonkeyPatch, stopped: list[Any]
):
    monkeypatch.setattr(SessionWorker, "stop", hangs)
    run = slow(runs, monkeypatch, {2: 1e9})
    stopped.append(run)
    record(run, 1, 5)
    run.worker.stop()
    found = summary(run, 1)
    assert found["recorded"].startswith("0 of 1 episode into ")
    assert found["unfinished"].endswith("episode_000001")
    (fault,) = run.runtime.session.outcome.faults
    assert fault.startswith("recording ended: ")
    assert "episode_000001: unfinished: the disk did not take the last " in fault


def test_an_operator_gives_up_a_slow_disk(runs: Runs, monkeypatch: pytest.MonkeyPatch, stopped: list[Any]):
    monkeypatch.setattr(SessionWorker, "stop", hangs)
    keys: queue.SimpleQueue[str] = queue.SimpleQueue()
    keys.put("tab")
    keys.put("f12")
    run = slow(runs, monkeypatch, {1: 1e9}, keys=lambda: keys)
    stopped.append(run)
    record(run, 1, 2)
    run.worker.stop()
    assert run.disk.now <= 5.0
    assert summary(run, 1)["recorded"].startswith("0 of 1 episode")


def test_a_recording_stops_after_the_robot(runs: Runs):
    """Otherwise a slow disk would let the source of commands go on after the end of the run."""
    runtime = runs.make("recording={type: lines}", mode="teleop")
    (worker,) = (each for each in runtime.plan.components if isinstance(each, RecordingWorker))
    assert worker.may_wait
    order: list[str] = []
    for component in runtime.plan.components:
        stop = component.stop
        component.stop = lambda name=component.name, stop=stop: (order.append(name), stop())  # type: ignore[misc,method-assign]
    runtime.start()
    halt = runtime.session.control.halt
    runtime.session.control.halt = lambda **asked: (order.append("halt"), halt(**asked))  # type: ignore[method-assign,assignment]
    runtime.stop()
    assert order.index("halt") < order.index("recording")


def test_disks_that_stall_anywhere(runs: Runs, monkeypatch: pytest.MonkeyPatch, stopped: list[Any]):
    """An episode counts as recorded exactly if the disk took all of it."""
    run = slow(runs, monkeypatch, {})
    stopped.append(run)
    run.worker.stop()
    faults = run.runtime.session.outcome.faults
    for seed in range(STALLS):
        draw = random.Random(seed)
        episodes, messages = draw.randint(1, 4), draw.randint(0, 5)
        calls = episodes * (messages + 1)
        stalls = {draw.randrange(calls): draw.choice([1.0, 25.0, 59.0, 200.0]) for _ in range(draw.randint(0, 3))}
        hung = min((call for call, stall in stalls.items() if stall > 60.0), default=None)
        whole = episodes if hung is None else hung // (messages + 1)
        with monkeypatch.context() as patch:
            if hung is not None:
                patch.setattr(SessionWorker, "stop", hangs)
            with_disk(run, patch, stalls)
            before, known = run.worker.saved, len(faults)
            record(run, episodes, messages)
            run.worker.stop()
            assert run.worker.saved - before == whole, (seed, stalls)
            assert len(faults) - known == (hung is not None), (seed, stalls)
            free(run)
        # What the disk took after it was given up counts for nobody: the process would have ended.
        run.worker._whole, run.worker._provisional, run.worker._ending = before + whole, 0, 0


@attrs.define(eq=False)
class Kept:
    """What a recorder received of each episode."""

    begun: list[int] = attrs.field(factory=list)
    written: list[list[tuple[str, int]]] = attrs.field(factory=list)
    ended: list[EpisodeEnd] = attrs.field(factory=list)

    def begin(self, episode: EpisodeStart) -> None:
        episode.directory.mkdir()
        self.begun.append(episode.stamp_ns)
        self.written.append([])

    def write(self, topic: str, message: Any, received_ns: int) -> None:
        self.written[-1].append((topic, int(message.data)))

    def end(self, episode: EpisodeEnd) -> None:
        self.ended.append(episode)


def lossy(runs: Runs, monkeypatch: pytest.MonkeyPatch) -> tuple[Runtime, RecordingWorker, Kept]:
    """A run in lockstep, not started, but its recording."""
    monkeypatch.setattr(recording, "_DEPTH", 8)
    runtime = runs.make("recording={type: lines, topics: [/a, /b, /c]}", mode="teleop")
    (worker,) = (each for each in runtime.plan.components if isinstance(each, RecordingWorker))
    worker.start()
    kept = Kept()
    for name in ("begin", "write", "end"):
        monkeypatch.setattr(worker.recorder, name, getattr(kept, name))
    return runtime, worker, kept


def publish(runtime: Runtime, topic: str, number: int) -> None:
    clock = runtime.session.clock
    assert isinstance(clock, SteppedClock)
    clock.advance(1000)
    runtime.session.bus.publish(topic, String(str(number)))


def test_an_episode_whose_end_was_lost_is_unknown(
    runs: Runs, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    runtime, worker, kept = lossy(runs, monkeypatch)
    caplog.set_level("INFO")
    worker.begin(1, "pick")
    publish(runtime, "/a", 0)
    worker.work(0.0)
    publish(runtime, "/a", 1)
    for number in range(2, 12):
        publish(runtime, "/b", number)
    worker.end("success")
    worker.work(0.0)
    assert [end.outcome for end in kept.ended] == ["unknown"], "the newest message of /a is lost"
    assert kept.ended[0].dropped == {"/a": 1, "/b": 2}
    (found,) = worker.written
    assert (found.stated, found.outcome, found.lost) == ("success", "unknown", {"/a": 1, "/b": 2})
    assert "the recording loses messages: 3 messages lost (/b 2, /a 1) so far" in caplog.text
    assert "episode_000001: unknown, 3 messages lost (/b 2, /a 1), its end was lost" in caplog.text
    service: Any = runtime.session.episodes
    rows = dict(Operator(runtime.session, service, 1, 0.0, "pick", auto=True, keys=False).summary_rows())
    assert rows["lost"] == "3 messages lost (/b 2, /a 1), in 1 of 1 episode"
    assert rows["unknown"].startswith("the end was lost of episode_000001 (was success); ")


def test_an_episode_that_lost_messages_in_the_middle_keeps_its_outcome(runs: Runs, monkeypatch: pytest.MonkeyPatch):
    runtime, worker, kept = lossy(runs, monkeypatch)
    worker.begin(1, "pick")
    for number in range(20):
        publish(runtime, "/a", number)
    worker.end("success")
    worker.work(0.0)
    assert [end.outcome for end in kept.ended] == ["success"]
    assert kept.ended[0].dropped == {"/a": 12}


def test_messages_lost_after_the_end_do_not_count(runs: Runs, monkeypatch: pytest.MonkeyPatch):
    """The recorder may take long to write what came before the end, while the queue overflows."""
    runtime, worker, kept = lossy(runs, monkeypatch)
    worker.begin(1, "pick")
    publish(runtime, "/a", 0)
    publish(runtime, "/b", 1)
    worker.end("success")

    def slowly(topic: str, message: Any, received_ns: int) -> None:
        for number in range(20):
            publish(runtime, "/b", number)
        kept.write(topic, message, received_ns)

    monkeypatch.setattr(worker.recorder, "write", slowly)
    worker.work(0.0)
    assert [(end.outcome, dict(end.dropped)) for end in kept.ended] == [("success", {})]


def test_losses_anywhere(runs: Runs, monkeypatch: pytest.MonkeyPatch):
    """An episode is unknown if the newest message of a topic is lost, and every loss is counted.

    Of messages lost after the end, before the recorder knew of it, nobody knows whether they came before; these count.
    """
    runtime, worker, kept = lossy(runs, monkeypatch)
    seen, number = Counter[tuple[str, str]](), 0
    for seed in range(LOSSES):
        draw, floods, own = random.Random(seed), False, list[tuple[str, int]]()
        worker.work(0.0)
        worker.begin(seed, "pick")
        for _ in range(draw.randint(0, 30)):
            if draw.random() < 0.15:
                worker.work(0.0)
            else:
                topic, number = f"/{draw.choice('aaaabc')}", number + 1
                publish(runtime, topic, number)
                own.append((topic, number))
        runtime.session.clock.advance(1000)  # type: ignore[attr-defined]
        worker.end("success")
        for _ in range(draw.choice([0, 0, 3, 20])):
            floods, number = True, number + 1
            publish(runtime, "/a", number)
        worker.work(0.0)
        written, end = kept.written[-1], kept.ended[-1]
        lost = Counter(topic for topic, _ in own) - Counter(topic for topic, _ in written)
        cut = any(dict(written).get(topic) != newest for topic, newest in dict(own).items())
        case = seed, own, written, end
        assert all(end.dropped.get(topic, 0) >= count for topic, count in lost.items()), case
        if cut:
            assert end.outcome == "unknown", case
        elif not floods:
            assert (end.outcome, end.dropped) == ("success", lost), case
        seen["cut" if cut else "lossy" if lost else "whole", end.outcome] += 1
    assert min(seen["cut", "unknown"], seen["lossy", "success"], seen["whole", "success"]) > LOSSES // 10, seen
    assert seen["lossy", "unknown"] + seen["whole", "unknown"] < LOSSES // 20, seen

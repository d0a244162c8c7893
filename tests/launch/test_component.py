"""Workers: ready before `start` returns, their deaths reported, stopped in time; in lockstep one step at a time."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import cast

import pytest

from ibrobot_core import component as module
from ibrobot_core.component import SessionWorker
from ibrobot_core.errors import ComponentFailed, SensorError
from ibrobot_core.interfaces.run import LaunchRequest, RunView

PATIENCE_S = 30.0


class Run:
    """What a worker needs of a run."""

    def __init__(self, *, lockstep: bool) -> None:
        self.request = LaunchRequest(lockstep=lockstep)
        self.finished = threading.Event()
        self.failures: list[tuple[str, Exception]] = []
        self.failed = threading.Event()

    def fail(self, name: str, error: Exception) -> None:
        self.failures.append((name, error))
        self.failed.set()


class Probe(SessionWorker):
    """Works when it is let, and notes what happens to it."""

    ready_timeout_s = PATIENCE_S

    def __init__(self, *, lockstep: bool = False, ready_after: int = 0) -> None:
        self.run = Run(lockstep=lockstep)
        super().__init__(cast(RunView, self.run), "probe", "a probe")
        self.calls: list[str] = []
        self.ready_after = ready_after
        self.timeouts: list[float] = []
        self.setup_error: Exception | None = None
        self.work_error: Exception | None = None
        self.let = threading.Semaphore(0)
        self.worked = threading.Semaphore(0)
        self.stuck = threading.Event()

    def setup(self) -> None:
        self.calls.append("setup")
        if self.setup_error is not None:
            raise self.setup_error

    def work(self, timeout_s: float) -> None:
        self.timeouts.append(timeout_s)
        if timeout_s > 0 and not self.let.acquire(timeout=timeout_s):
            return
        self.calls.append("work")
        self.worked.release()
        if self.work_error is not None:
            raise self.work_error

    def teardown(self) -> None:
        self.calls.append("teardown")

    def is_ready(self) -> bool:
        return self.calls.count("work") >= self.ready_after

    def not_ready(self) -> str:
        return "no sign of life"


@pytest.fixture
def probe() -> Iterator[Probe]:
    made = Probe()
    yield made
    made.stop()


def test_start_returns_when_it_is_ready(probe: Probe):
    probe.ready_after = 3
    probe.let.release(3)
    probe.start()
    assert probe.calls == ["setup", "work", "work", "work"]
    probe.stop()
    assert probe.calls[-1] == "teardown"
    assert probe.run.failures == []


def test_one_that_does_not_become_ready_is_reported():
    probe = Probe(ready_after=1)
    probe.ready_timeout_s = 0.01
    with pytest.raises(ComponentFailed, match=r"^no sign of life after 0\.01 s$"):
        probe.start()
    probe.stop()
    assert probe.calls == ["setup", "teardown"]


def test_the_end_of_the_run_ends_the_wait():
    probe = Probe(ready_after=1)
    probe.run.finished.set()
    with pytest.raises(ComponentFailed, match=r"^no sign of life when the run ended$"):
        probe.start()
    probe.stop()
    assert probe.calls == ["setup", "teardown"]


def test_what_fails_before_it_is_ready_is_raised_by_start_alone(probe: Probe):
    probe.setup_error = SensorError("no such device")
    with pytest.raises(SensorError, match="no such device"):
        probe.start()
    assert probe.calls == ["setup", "teardown"]
    assert probe.run.failures == []


def test_one_that_dies_later_is_reported_to_the_run(probe: Probe):
    probe.start()
    probe.work_error = SensorError("unplugged")
    probe.let.release()
    assert probe.run.failed.wait(PATIENCE_S)
    assert probe.run.failures == [("probe", probe.work_error)]
    assert probe.calls == ["setup", "work", "teardown"]


def test_it_can_be_started_again(probe: Probe):
    probe.start()
    probe.stop()
    probe.start()
    probe.let.release()
    assert probe.worked.acquire(timeout=PATIENCE_S)
    probe.stop()
    assert probe.calls == ["setup", "teardown", "setup", "work", "teardown"]


def test_stopping_twice_tears_down_once(probe: Probe):
    probe.start()
    probe.stop()
    probe.stop()
    assert probe.calls == ["setup", "teardown"]


def test_one_that_hangs_is_named_and_left(monkeypatch: pytest.MonkeyPatch):
    release = threading.Event()

    class Hanging(Probe):
        def work(self, timeout_s: float) -> None:
            self.worked.release()
            assert release.wait(PATIENCE_S)

    probe = Hanging()
    probe.start()
    assert probe.worked.acquire(timeout=PATIENCE_S)
    monkeypatch.setattr(module, "_STOP_TIMEOUT_S", 0.01)
    with pytest.raises(ComponentFailed, match=r"^probe hangs: still working 0\.01 s after the stop$"):
        probe.stop()
    monkeypatch.setattr(module, "_STOP_TIMEOUT_S", PATIENCE_S)
    release.set()
    probe.stop()
    assert probe.calls == ["setup", "teardown"]


def test_a_pause_ends_with_the_stop():
    class Pausing(Probe):
        def work(self, timeout_s: float) -> None:
            self.worked.release()
            self.pause(1000.0)

    probe = Pausing()
    probe.start()
    assert probe.worked.acquire(timeout=PATIENCE_S)
    probe.stop()
    assert probe.calls == ["setup", "teardown"]


def test_in_lockstep_it_works_once_a_step_without_a_thread_and_without_waiting():
    before = threading.active_count()
    probe = Probe(lockstep=True, ready_after=100)
    probe.start()
    assert probe.calls == ["setup"]
    probe.step(1)
    probe.step(2)
    assert threading.active_count() == before
    assert probe.timeouts == [0.0, 0.0]
    probe.stop()
    probe.stop()
    assert probe.calls == ["setup", "work", "work", "teardown"]


def test_in_lockstep_a_failure_is_raised_where_it_happens():
    probe = Probe(lockstep=True)
    probe.start()
    probe.work_error = SensorError("unplugged")
    with pytest.raises(SensorError, match="unplugged"):
        probe.step(1)
    probe.stop()
    assert probe.calls == ["setup", "work", "teardown"]


def test_in_lockstep_a_failed_setup_is_torn_down():
    probe = Probe(lockstep=True)
    probe.setup_error = SensorError("no such device")
    with pytest.raises(SensorError):
        probe.start()
    probe.stop()
    assert probe.calls == ["setup", "teardown"]

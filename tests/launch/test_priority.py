"""Workers' threads: their priority beside other programs."""

from __future__ import annotations

import os
import threading
from typing import TYPE_CHECKING, Any

import pytest

from ibrobot_core.component import SessionWorker
from ibrobot_core.launch.perception import SensorWorker

if TYPE_CHECKING:
    from fake_runs import Runs


class Patient(SessionWorker):
    """A worker whose units of work may be long."""

    def work(self, timeout_s: float) -> None:
        self.pause(timeout_s)


@pytest.fixture
def scheduled(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, int, int]]:
    """Name of the thread, scheduler and priority of each request; the machine itself is not asked."""
    asked: list[tuple[str, int, int]] = []

    def note(process: int, policy: int, param: Any) -> None:
        assert process == 0
        asked.append((threading.current_thread().name, policy, param.sched_priority))

    monkeypatch.setattr(os, "sched_setscheduler", note)
    return asked


def sensor(runs: Runs, *, lockstep: bool) -> SensorWorker:
    session = runs.make(lockstep=lockstep).session
    return SensorWorker(session, session.config.peripherals["top"], ())


def test_a_sensor_is_read_at_the_lowest_real_time_priority(runs: Runs, scheduled: list[tuple[str, int, int]]):
    worker = sensor(runs, lockstep=False)
    worker.start()
    worker.stop()
    assert scheduled == [("sensor:top", os.SCHED_RR | os.SCHED_RESET_ON_FORK, 1)]


def test_a_worker_that_does_not_opt_in_has_the_ordinary_priority(runs: Runs, scheduled: list[tuple[str, int, int]]):
    worker = Patient(runs.make().session, "search", "")
    worker.start()
    worker.stop()
    assert scheduled == []


def test_in_lockstep_no_thread_is_preferred(runs: Runs, scheduled: list[tuple[str, int, int]]):
    worker = sensor(runs, lockstep=True)
    worker.start()
    worker.stop()
    assert scheduled == []


def test_a_sensor_works_where_the_machine_refuses_the_priority(runs: Runs, monkeypatch: pytest.MonkeyPatch):
    def refuse(*_: Any) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    worker = sensor(runs, lockstep=False)
    worker.start()
    worker.stop()
    assert worker.is_ready()

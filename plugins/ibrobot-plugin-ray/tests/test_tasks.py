"""What a task of Ray does on a machine of the cluster, here called directly."""

from __future__ import annotations

import os
import re
import socket
from pathlib import Path
from typing import Any

import pytest
from ibrobot_provenance.jobs import Job
from ibrobot_ray import pool
from ibrobot_testing.pool_jobs import Order, divide, fail_if_odd, process, square


class Counts:
    """Stands in for the actor that counts."""

    def __init__(self) -> None:
        self.told: list[tuple[int, int]] = []
        self.tell = self

    def remote(self, number: int, count: int) -> None:
        self.told.append((number, count))


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of this process, to which it returns afterwards."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def do(job: Job[Any], folder: Path, counts: Counts | None = None, **versions: str) -> Any:
    return pool._do(job, 3, counts or Counts(), str(folder), pool._versions() | versions)


def test_task_returns_progress_and_result_of_its_job(here: Path) -> None:
    assert do(Job(square, Order(4)), here) == (4, (16, None))


def test_task_reports_its_progress(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pool, "_REPORT_S", 0.0)
    counts = Counts()
    do(Job(square, Order(2)), here, counts)
    assert counts.told == [(3, 1), (3, 2)]


def test_task_works_in_the_folder_of_the_command(here: Path) -> None:
    (here / "below").mkdir()
    assert do(Job(process, Order(0)), here / "below") == (0, ((os.getpid(), str((here / "below").resolve())), None))


def test_error_of_a_job_comes_back(here: Path) -> None:
    _, (value, error) = do(Job(fail_if_odd, Order(1)), here)
    assert (value, str(error), error.exit_code) == (None, "1 is odd", 7)


def test_machine_without_the_folder_is_named(here: Path) -> None:
    _, (_, error) = do(Job(square, Order(1)), here / "missing")
    assert "missing: No such file or directory; run the command in a folder that all machines share" in str(error)


@pytest.mark.parametrize("name", ["Python", "ray", "numpy", "ibrobot-core", "ibrobot-plugin-ray"])
def test_machine_with_other_code_is_named(here: Path, name: str) -> None:
    _, (_, error) = do(Job(square, Order(1)), here, None, **{name: "0.7"})
    assert f"has other versions than this one: {name} {pool._versions()[name]}, not 0.7" in str(error)


def test_machine_without_a_package_is_named(here: Path) -> None:
    _, (_, error) = do(Job(square, Order(1)), here, torch="2.9")
    assert "torch missing, not 2.9" in str(error)


def test_traceback_of_a_bug_names_its_machine(here: Path) -> None:
    _, (_, error) = do(Job(divide, Order(0)), here)
    assert "ZeroDivisionError" in str(error)
    assert re.search(rf"its traceback is in \S+\.log on machine {re.escape(socket.gethostname())}\)$", str(error))


def test_counts_are_those_of_the_running_jobs() -> None:
    counts = pool._Counts()
    for number, count in ((0, 5), (1, 2), (0, 6)):
        counts.tell(number, count)
    assert counts.of([0, 1]) == 8
    assert counts.of([1]) == 2
    assert counts.of([0, 1]) == 2

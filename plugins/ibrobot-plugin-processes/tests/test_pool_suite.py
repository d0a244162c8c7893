"""The pool passes the suite, and each check of the suite catches something wrong."""

from __future__ import annotations

import inspect
import itertools
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Generator, Iterable
from contextlib import closing
from pathlib import Path
from typing import Any, ClassVar

import ibrobot_processes.pool
import pytest
from ibrobot_provenance.jobs import Done, Job, Pool, open_pool
from ibrobot_provenance.pool_suite import PoolSuite
from ibrobot_testing import checks
from ibrobot_testing.pool_jobs import Order, wait

from ibrobot_core.app import ComponentFailed, RequestError


def process_pool(jobs: int) -> Pool:
    """The default pool."""
    return open_pool("", jobs)


class TestProcessPool(PoolSuite):
    def pool(self, jobs):
        return process_pool(jobs)


class Wrong(Pool):
    """A pool with a fault; the rest is that of this package."""

    def __init__(self, jobs: int) -> None:
        self.pool = process_pool(jobs)

    def run(self, jobs: Iterable[Job[Any]], watch: Callable[[int], None] = lambda count: None) -> Generator[Done[Any]]:
        with closing(self.pool.run(self.before(jobs), self.watched(watch))) as running:
            for done in running:
                yield from self.after(done)

    def before(self, jobs: Iterable[Job[Any]]) -> Iterable[Job[Any]]:
        return jobs

    def watched(self, watch: Callable[[int], None]) -> Callable[[int], None]:
        return watch

    def after(self, done: Done[Any]) -> Iterable[Done[Any]]:
        return [done]


class Twice(Wrong):
    def after(self, done):
        return [done, done]


class OneMore(Wrong):
    def __init__(self, jobs):
        super().__init__(jobs + 1)


class AllAtOnce(Wrong):
    def before(self, jobs):
        return list(itertools.islice(jobs, 100))


class Unwatched(Wrong):
    def watched(self, watch):
        return lambda count: watch(0)


class PlainErrors(Wrong):
    def after(self, done):
        if done.error is not None:
            done.error.exit_code = 1
        return [done]


class HidesErrors(Wrong):
    def after(self, done):
        return [Done(done.job, done.value)]


class GivesUp(Wrong):
    def after(self, done):
        return [Done(done.job, None, ComponentFailed("its process was killed"))]


class CountsTheDead(Wrong):
    """What a job told before its last process died stays in the count."""

    count = dead = 0

    def watched(self, watch):
        def told(count):
            self.count = count
            watch(count + self.dead)

        self.told = told
        return told

    def after(self, done):
        self.dead += done.error is not None
        self.told(self.count)
        return [done]


class KeepsProcesses(Wrong):
    def before(self, jobs):
        return (Job(each.function, each.argument) for each in jobs)


class OtherFolder(Wrong):
    def before(self, jobs):
        os.chdir("/")
        return jobs


class GoesOn(Wrong):
    """Closing it leaves its jobs running."""

    left: ClassVar[list[Any]] = []

    def run(self, jobs, watch=lambda count: None):
        running = self.pool.run(jobs, watch)
        self.left.append(running)
        for done in running:  # noqa: UP028 - `yield from` would close it
            yield done


WRONG = [
    (Twice, "each_job_is_done_once"),
    (AllAtOnce, "jobs_begin_in_their_order_when_there_is_room_for_them"),
    (OneMore, "no_more_jobs_run_than_asked"),
    (Unwatched, "progress_of_all_jobs_is_counted"),
    (PlainErrors, "error_of_a_job_is_its_own"),
    (HidesErrors, "bug_in_a_job_is_an_error"),
    (HidesErrors, "job_that_kills_each_process_fails_and_others_do_not"),
    (CountsTheDead, "job_that_kills_each_process_fails_and_others_do_not"),
    (GivesUp, "job_whose_process_is_killed_is_run_again"),
    (GoesOn, "closing_ends_the_jobs_that_run"),
    (KeepsProcesses, "own_processes_run_one_job_each_in_the_same_folder"),
    (OtherFolder, "own_processes_run_one_job_each_in_the_same_folder"),
]


@pytest.mark.parametrize(("kind", "check"), WRONG, ids=lambda value: getattr(value, "__name__", value))
def test_wrong_pool_fails(kind: Any, check: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Subject(PoolSuite):
        patience_s = 2.0

        def pool(self, jobs):
            return kind(jobs)

    given = {"jobs": 1, "tmp_path": tmp_path, "monkeypatch": monkeypatch}
    bound = getattr(Subject(), f"test_{check}")
    with pytest.raises((AssertionError, ComponentFailed)):
        bound(**{name: given[name] for name in inspect.signature(bound).parameters})
    for running in GoesOn.left:
        running.close()
    GoesOn.left.clear()


def test_every_check_catches_something() -> None:
    assert checks(PoolSuite) == {check for _, check in WRONG}


def test_processes_have_no_address() -> None:
    with pytest.raises(RequestError, match="processes://here: processes run on this machine"):
        open_pool("processes://here")


def test_pool_uses_every_core_by_default(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As many jobs run at once as there are cores, and no more."""
    monkeypatch.setattr(ibrobot_processes.pool, "cores", lambda: 3)

    def watch(_: int) -> None:
        if len(list(tmp_path.glob("began_*"))) == 3:
            (tmp_path / "go").touch()

    with closing(open_pool("")) as pool:
        done = list(pool.run([Job(wait, Order(number, str(tmp_path))) for number in range(3)], watch))
    assert sorted(each.result() for each in done) == [0, 1, 2]


IN_A_THREAD = """
import signal
import threading
from contextlib import closing

from ibrobot_provenance.jobs import Job, open_pool


def blocked(argument, progress):
    return [int(each) for each in signal.pthread_sigmask(signal.SIG_BLOCK, ())]


def run():
    with closing(open_pool("", 1)) as pool:
        print([done.value for done in pool.run([Job(blocked, None)])])


def main():
    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
"""


def test_ctrl_c_reaches_no_worker_also_if_a_thread_runs_the_pool(tmp_path: Path) -> None:
    """Otherwise each would print a traceback."""
    (tmp_path / "in_a_thread.py").write_text(IN_A_THREAD)
    command = (sys.executable, "-c", "import in_a_thread; in_a_thread.main()")
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120, check=True)
    assert done.stdout == f"[[{int(signal.SIGINT)}]]\n", done.stderr

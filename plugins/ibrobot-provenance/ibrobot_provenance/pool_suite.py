"""The conformance suite of pools."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, ClassVar

import pytest
from ibrobot_testing.pool_jobs import (
    Order,
    count_begun,
    die_if_odd,
    die_once,
    divide,
    fail_if_odd,
    process,
    square,
    wait,
)
from ibrobot_testing.suite import Suite, wait_until

from ibrobot_provenance.jobs import Job, Pool


class PoolSuite(Suite[Pool]):
    """Checks of every `Pool`. The subclass defines `pool`."""

    patience_s: ClassVar[float] = 60.0
    """Time for whatever the pool does [s]."""

    @pytest.fixture(autouse=True)
    def no_leaks(self) -> Iterator[None]:
        """Fail a check that leaks a thread, a process, an open file or a port."""
        with self.opened(1) as pool:  # what lives as long as the interpreter is no leak
            list(pool.run([Job(square, Order(1))]))
        with self.leak_check.watch():
            yield

    def pool(self, jobs: int) -> Pool:
        """A new pool for at most `jobs` jobs at once."""
        raise NotImplementedError(f"{type(self).__name__} must define pool(self, jobs)")

    @contextmanager
    def opened(self, jobs: int) -> Iterator[Pool]:
        """A pool that is closed afterwards."""
        with closing(self.pool(jobs)) as pool:
            yield pool

    @pytest.mark.parametrize("jobs", [1, 3])
    def test_each_job_is_done_once(self, jobs: int) -> None:
        """Every job comes back once, with its result."""
        work = [Job(square, Order(number)) for number in range(7)]
        with self.opened(jobs) as pool:
            done = list(pool.run(work))
        assert {each.job for each in done} == set(work)
        assert sorted(each.result() for each in done) == [number**2 for number in range(7)]

    def test_jobs_begin_in_their_order_when_there_is_room_for_them(self) -> None:
        """Jobs are taken in their order, and not all at once."""
        taken: list[int] = []

        def work() -> Iterator[Job[int]]:
            for number in itertools.count():
                taken.append(number)
                yield Job(square, Order(number))

        with self.opened(1) as pool, closing(pool.run(work())) as running:
            assert [next(running).result() for _ in range(4)] == [0, 1, 4, 9]
        assert len(taken) <= 6, "jobs are taken as there is room for them, and not all at once"

    def test_no_more_jobs_run_than_asked(self, tmp_path: Path) -> None:
        """A pool for one job at once begins the second when the first has ended."""
        with self.opened(1) as pool:
            done = list(pool.run([Job(count_begun, Order(number, str(tmp_path))) for number in range(2)]))
        assert sorted(each.result() for each in done) == [1, 2], "two jobs ran at once"

    def test_progress_of_all_jobs_is_counted(self) -> None:
        """The last count is the sum of the progress of all jobs."""
        counts: list[int] = []
        with self.opened(2) as pool:
            list(pool.run([Job(square, Order(number)) for number in (5, 0, 7)], counts.append))
        assert counts[-1] == 12

    def test_error_of_a_job_is_its_own(self) -> None:
        """An error keeps class, text and exit code, and affects no other job."""
        with self.opened(2) as pool:
            done = {each.job.argument.number: each for each in pool.run([Job(fail_if_odd, Order(n)) for n in (1, 2)])}
        assert done[2].result() == 2
        error = done[1].error
        assert error is not None
        assert (type(error).__name__, str(error), error.exit_code) == ("DatasetError", "1 is odd", 7)

    def test_bug_in_a_job_is_an_error(self) -> None:
        """An exception of another class than ibrobot's errors is reported, too."""
        with self.opened(1) as pool:
            (done,) = pool.run([Job(divide, Order(0))])
        assert "ZeroDivisionError" in str(done.error)

    def test_job_whose_process_is_killed_is_run_again(self, tmp_path: Path) -> None:
        """A killed process costs no job, and its progress does not count."""
        counts: list[int] = []
        jobs = [Job(die_once, Order(number, str(tmp_path))) for number in range(3)]
        with self.opened(2) as pool, closing(pool.run(jobs, counts.append)) as done:
            assert sorted(each.result() for each in done) == [0, 1, 2]
        assert counts[-1] == 3, "the progress of a process that died does not count"

    def test_job_that_kills_each_process_fails_and_others_do_not(self) -> None:
        """A job with which several processes have died fails alone, and its progress does not count."""
        counts: list[int] = []
        with self.opened(2) as pool:
            ran = pool.run([Job(die_if_odd, Order(number)) for number in range(3)], counts.append)
            done = {each.job.argument.number: each for each in ran}
        assert (done[0].result(), done[2].result()) == (0, 2)
        assert done[1].error is not None
        assert done[1].value is None
        assert counts[-1] == 2, "the progress of a job with which processes died does not count"

    def test_own_processes_run_one_job_each_in_the_same_folder(self, tmp_path: Path, monkeypatch: Any) -> None:
        """A job with `own_process` gets a new process, in the folder of the caller."""
        monkeypatch.chdir(tmp_path)
        jobs = [Job(process, Order(number), own_process=True) for number in range(3)]
        with self.opened(1) as pool, closing(pool.run(jobs)) as running:
            done = [each.result() for each in running]
        assert len({pid for pid, _ in done}) == 3
        assert {folder for _, folder in done} == {str(tmp_path.resolve())}

    def test_closing_ends_the_jobs_that_run(self, tmp_path: Path) -> None:
        """No process goes on with a job after the generator is closed."""
        began = tmp_path / "began_0"
        with self.opened(2) as pool:
            with closing(pool.run([Job(wait, Order(0, str(tmp_path))), Job(square, Order(2))])) as running:
                assert next(running).result() == 4
                wait_until(began.exists, self.patience_s)
            process = Path("/proc") / began.read_text()
            wait_until(lambda: not process.exists(), self.patience_s)

"""The pool `processes`: jobs in worker processes on this machine."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from multiprocessing import connection, forkserver, resource_tracker
from multiprocessing.context import ForkServerContext
from typing import Any, override

import attrs
from ibrobot_provenance.jobs import Done, Job, Pool

from ibrobot_core.app import ComponentFailed, end_signals

TRIES = 3
"""Number of processes that may die with the same job."""
_POLL_S = 0.2
_REPORT_S = 0.1
"""Least time between two reports of progress of a process."""


def cores() -> int:
    """Number of CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@attrs.define(eq=False)
class _Task:
    """A job, its progress in the present process, and the number of processes that have died with it."""

    job: Job[Any]
    progress: int = 0
    deaths: int = 0


class ProcessPool(Pool):
    """Worker processes, forked from one with this process's imports, so that they start quickly.

    Args:
        jobs: number of processes; None for one for each core.
    """

    def __init__(self, jobs: int | None) -> None:
        self._limit = jobs or cores()

    @override
    def run[R](self, jobs: Iterable[Job[R]], watch: Callable[[int], None] = lambda count: None) -> Generator[Done[R]]:
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload([name for name in sys.modules if name.startswith("ibrobot_")])
        todo, again, finished = map(_Task, jobs), deque[_Task](), 0
        busy: dict[_Worker, _Task] = {}
        idle: list[_Worker] = []
        try:
            while True:
                while len(busy) < self._limit and (task := again.popleft() if again else next(todo, None)):
                    fresh = task.job.own_process or not idle
                    worker = _Worker(context) if fresh else idle.pop()
                    busy[worker] = task
                    worker.send(task.job)
                if not busy:
                    return
                connection.wait([each for worker in busy for each in worker.signs], _POLL_S)
                for worker, task in tuple(busy.items()):
                    alive = worker.alive
                    if (outcome := worker.outcome(task)) is None and alive:
                        continue
                    del busy[worker]
                    if outcome is None:
                        task.deaths, task.progress, cause = task.deaths + 1, 0, worker.end()
                        if task.deaths < TRIES:
                            again.append(task)
                            continue
                        outcome = None, ComponentFailed(f"its process was lost {TRIES} times: {cause}")
                    elif task.job.own_process:
                        worker.end()
                    else:
                        idle.append(worker)
                    finished += task.progress
                    watch(finished + sum(each.progress for each in busy.values()))
                    yield Done(task.job, *outcome)
                watch(finished + sum(task.progress for task in busy.values()))
        finally:
            for worker in (*busy, *idle):
                worker.end()


class _Worker:
    """A process, and the connection to it."""

    def __init__(self, context: ForkServerContext) -> None:
        self._connection, theirs = context.Pipe()
        self._process = context.Process(target=_work, args=(theirs, dict(os.environ)), daemon=True)
        resource_tracker.ensure_running()  # which would unblock Ctrl-C
        with theirs, _deferred_signals():
            forkserver.ensure_running()
            self._process.start()

    @property
    def signs(self) -> tuple[Any, ...]:
        """Objects for `connection.wait`: a message, and the end of the process."""
        return self._connection, self._process.sentinel

    @property
    def alive(self) -> bool:
        return self._process.is_alive()

    def send(self, job: Job[Any]) -> None:
        with suppress(OSError):  # it has died, which `alive` tells
            self._connection.send(job)

    def outcome(self, task: _Task) -> Any:
        """Result and error of its job if it is done; updates the progress of the task."""
        with suppress(EOFError, OSError):  # it has died
            while self._connection.poll():
                task.progress, outcome = self._connection.recv()
                if outcome is not None:
                    return outcome
        return None

    def end(self) -> str:
        """Kill the process. Returns why it had ended."""
        self._process.kill()
        self._process.join()
        status = self._process.exitcode or 0
        self._process.close()
        self._connection.close()
        return f"killed by {signal.Signals(-status).name}" if status < 0 else f"exit status {status}"


def _work(channel: connection.Connection, environment: Mapping[str, str]) -> None:
    """Run the jobs sent by the parent, until none are left or the parent dies."""
    os.environ.clear()
    os.environ.update(environment)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with suppress(EOFError):
        while True:
            job, counter = channel.recv(), _Counter(channel)
            outcome = job.run(counter)
            channel.send((counter.count, outcome))


class _Counter:
    """Adds up the progress of a job, and reports it at intervals."""

    def __init__(self, channel: connection.Connection) -> None:
        self.count = 0
        self._channel = channel
        self._told_s = time.monotonic()

    def __call__(self, more: int) -> None:
        self.count += more
        if (now_s := time.monotonic()) - self._told_s >= _REPORT_S:
            self._told_s = now_s
            self._channel.send((self.count, None))


def _end_with_parent() -> None:
    """Exit when the parent is killed, so as not to write at the same time as the next run."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


@contextmanager
def _deferred_signals() -> Iterator[None]:
    """Defer Ctrl-C, SIGTERM and SIGHUP; block Ctrl-C in the processes started here, which would print tracebacks."""
    came: list[int] = []
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # child processes inherit it
    handlers = {}
    if threading.current_thread() is threading.main_thread():  # Python delivers signals to it alone
        handlers = {number: signal.signal(number, lambda number, _: came.append(number)) for number in end_signals()}
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for number, handler in handlers.items():
            signal.signal(number, handler)
    if came:
        signal.raise_signal(came[0])

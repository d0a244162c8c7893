"""The pool `ray`: each job is a Ray task. Ray chooses its machine, and repeats it if its process dies."""

from __future__ import annotations

import logging
import os
import re
import signal
import socket
import tempfile
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, override

os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # before Ray reads it
os.environ.setdefault("RAY_ENABLE_UV_RUN_RUNTIME_ENV", "0")  # `uv run` would make Ray build an environment per job

import ray
from ibrobot_provenance.code import differing_code, installed_code
from ibrobot_provenance.jobs import Done, Job, Pool

from ibrobot_core.api import IbrobotError
from ibrobot_core.app import ComponentFailed, installed_plugins

RETRIES = 4
"""Maximum number of retries of a job whose process or machine was lost."""
_POLL_S = 0.5
_REPORT_S = 0.5
"""Minimum time between two progress reports of a job."""
_AHEAD = 2
"""Jobs queued at Ray for each running job, so that no machine has to wait for this one."""


def _versions() -> dict[str, str]:
    """Code that must be equal on all machines."""
    return installed_code(installed_plugins().versions())


class _Counts:
    """An actor: the progress of the jobs that run."""

    def __init__(self) -> None:
        self._counts: dict[int, int] = {}

    def tell(self, number: int, count: int) -> None:
        self._counts[number] = count

    def of(self, numbers: list[int]) -> int:
        """The progress of these jobs together; forgets the others."""
        self._counts = {number: self._counts[number] for number in numbers if number in self._counts}
        return sum(self._counts.values())


def _do(job: Job[Any], number: int, counts: Any, folder: str, versions: Mapping[str, str]) -> Any:
    """Run a job as a Ray task. Returns its progress and its outcome."""
    here = socket.gethostname()
    if wrong := differing_code(versions, _versions()):
        return 0, (None, ComponentFailed(f"machine {here} has other versions than this one: {'; '.join(wrong)}"))
    try:
        os.chdir(folder)
    except OSError as error:
        reason = f"machine {here}: {folder}: {error.strerror}; run the command in a folder that all machines share"
        return 0, (None, ComponentFailed(reason))
    done, told_s = 0, time.monotonic()

    def progress(more: int) -> None:
        nonlocal done, told_s
        done += more
        if (now_s := time.monotonic()) - told_s >= _REPORT_S:
            told_s = now_s
            counts.tell.remote(number, done)

    value, failure = job.run(progress)
    return done, (value, _placed(failure, here))


def _placed(error: IbrobotError | None, machine: str) -> IbrobotError | None:
    """An error that names the machine of the files with tracebacks that its text names."""
    logs = rf"{re.escape(tempfile.gettempdir())}/[^\s)]+\.log"
    if error is None or not re.search(logs, str(error)):
        return error
    return ComponentFailed(re.sub(logs, rf"\g<0> on machine {machine}", str(error)), error.exit_code)


class RayPool(Pool):
    """A Ray cluster.

    Args:
        address: `HOST:PORT` of the Ray client server; empty for the cluster that Ray finds, or one of this machine.
        jobs: number of jobs at a time; None for one for each core of the cluster.

    Raises:
        ComponentFailed: if the cluster cannot be reached.
    """

    def __init__(self, address: str, jobs: int | None) -> None:
        self._limit = jobs
        where: Any = {"address": f"ray://{address}"} if address else {}
        try:
            with _own_signals():
                ray.init(**where, log_to_driver=False, logging_level=logging.ERROR, configure_logging=False)
        except (ray.exceptions.RayError, ConnectionError, RuntimeError, ValueError, OSError) as error:
            raise ComponentFailed(f"the Ray cluster {address or 'of this machine'} cannot be used: {error}") from error
        self._plain = ray.remote(num_cpus=1, max_retries=RETRIES)(_do)
        self._fresh = ray.remote(num_cpus=1, max_retries=RETRIES, max_calls=1)(_do)
        self._counts: Any = ray.remote(num_cpus=0, max_restarts=-1)(_Counts).remote()

    def _room(self) -> int:
        """Number of jobs to hand to Ray."""
        return self._limit or _AHEAD * max(1, int(self._resources().get("CPU", 1)))

    def _resources(self) -> Mapping[str, float]:
        resources: Any = ray.cluster_resources  # without types
        available: Mapping[str, float] = resources()
        return available

    @override
    def run[R](self, jobs: Iterable[Job[R]], watch: Callable[[int], None] = lambda count: None) -> Generator[Done[R]]:
        here, versions = os.getcwd(), _versions()
        todo = enumerate(jobs)
        running: dict[Any, tuple[int, Job[R]]] = {}
        finished = 0
        try:
            while True:
                room = self._room()
                while len(running) < room and (taken := next(todo, None)):
                    number, job = taken
                    task = self._fresh if job.own_process else self._plain
                    if job.gpus and self._resources().get("GPU"):
                        task = task.options(num_gpus=job.gpus)
                    running[task.remote(job, number, self._counts, here, versions)] = taken
                if not running:
                    return
                ready, _ = ray.wait(list(running), timeout=_POLL_S)
                for reference in ready:
                    _, job = running.pop(reference)
                    done, outcome = _outcome(reference)
                    finished += done
                    watch(finished)
                    yield Done(job, *outcome)
                watch(finished + self._progress([number for number, _ in running.values()]))
        except ConnectionError as error:
            raise ComponentFailed(f"the Ray cluster cannot be reached any more: {error}") from error
        finally:
            for reference in running:
                ray.cancel(reference, force=True)

    def _progress(self, numbers: list[int]) -> int:
        """The progress of jobs that run, as far as it is known now."""
        if not numbers:
            return 0
        try:
            count: int = ray.get(self._counts.of.remote(numbers), timeout=_POLL_S)
        except (ray.exceptions.GetTimeoutError, ray.exceptions.RayActorError):  # it starts, or moves to another machine
            return 0
        return count

    @override
    def close(self) -> None:
        ray.shutdown()


def _outcome(reference: Any) -> tuple[int, tuple[Any, IbrobotError | None]]:
    """Progress and outcome of a job that Ray has done, or given up."""
    try:
        outcome: tuple[int, tuple[Any, IbrobotError | None]] = ray.get(reference)
    except ray.exceptions.RayTaskError as error:  # before the job began
        found_ip = re.search(r"ip=([^,)\s]+)", str(error))
        machine = f"machine {found_ip[1]}" if found_ip else "a machine"
        return 0, (None, ComponentFailed(f"{machine} of the cluster cannot run it: {error.cause or error}"))
    except ray.exceptions.RayError as error:
        lines = str(error).strip().splitlines() or [""]
        reason = f"its process was lost {RETRIES + 1} times: {type(error).__name__}: {lines[0]}"
        return 0, (None, ComponentFailed(reason))
    return outcome


@contextmanager
def _own_signals() -> Iterator[None]:
    """Keep the handler of SIGTERM, which Ray replaces."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handler = signal.getsignal(signal.SIGTERM)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, handler)

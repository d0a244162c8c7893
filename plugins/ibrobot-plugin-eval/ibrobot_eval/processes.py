"""Runs the jobs of an evaluation in worker processes, each of which does one job after another."""

from __future__ import annotations

import logging
import os
import select
import sys
from collections import deque
from collections.abc import Generator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import attrs

from ibrobot_core.api import IbrobotError
from ibrobot_core.app import Child, ComponentFailed, Failure, error_text, open_parent
from ibrobot_eval.episodes import Place, Result, run_episode
from ibrobot_eval.film import film
from ibrobot_eval.policies import Policy

_TRIES = 3
"""Number of processes that may die with the same job."""
_POLL_S = 0.5
_END_S = 5.0
"""A worker that takes longer to end is killed."""


@attrs.frozen
class Job:
    """An episode to run, or to film."""

    out: str
    """The folder of the evaluation."""
    policy: Policy
    seed: int
    document: str = ""
    """Hash of the robot YAML with which the evaluation began; empty to film an episode that has been run."""

    @classmethod
    def of(cls, order: dict[str, Any]) -> Job:
        """The job of an order to a worker."""
        fields = order["policy"]
        policy = Policy(**fields | {name: tuple(fields[name]) for name in ("overrides", "vary")})
        return cls(order["out"], policy, order["seed"], order["document"])


def run_jobs(jobs: Sequence[Job], processes: int) -> Generator[Job]:
    """Run jobs in worker processes, and yield each that is done. One whose process was killed is run again.

    Raises:
        ComponentFailed: if a job fails, or several processes have died with it.
    """
    todo = deque(jobs)
    workers: list[_Worker] = []
    deaths: dict[Job, int] = {}
    try:
        while todo or any(worker.job for worker in workers):
            while todo and len(workers) < processes:
                workers.append(_Worker())
            for worker in workers:
                if worker.job is None and todo:
                    worker.job = todo.popleft()
                    worker.child.channel.send(attrs.asdict(worker.job))
            select.select([worker.child.channel for worker in workers], [], [], _POLL_S)
            for worker in tuple(workers):
                alive = worker.child.alive
                done = worker.child.receive()
                if done and worker.job is not None:
                    job, worker.job = worker.job, None
                    yield job
                elif worker.child.failure is not None or not alive:
                    workers.remove(worker)
                    todo.extendleft(_lost(worker, deaths))
    finally:
        for worker in workers:
            worker.child.kill()
        for worker in workers:
            worker.child.end(_END_S)
            worker.child.channel.close()


class _Worker:
    """A worker process, and its job."""

    def __init__(self) -> None:
        self.child = Child("ibrobot_eval.processes", {})
        self.job: Job | None = None


def _lost(worker: _Worker, deaths: dict[Job, int]) -> list[Job]:
    """The job of a worker that has died, for others; raise the error if it failed, or died too often."""
    cause = worker.child.cause(_END_S)
    worker.child.channel.close()
    job = worker.job
    if job is None:
        return []
    deaths[job] = deaths.get(job, 0) + 1
    if worker.child.failure is None and deaths[job] < _TRIES:
        return [job]
    times = f" ({deaths[job]} times)" if deaths[job] > 1 else ""
    failed = ComponentFailed(f"{job.policy.label}, seed {job.seed}: {cause}{times}; finished episodes are kept")
    if worker.child.failure is not None:
        failed.exit_code = worker.child.failure.exit_code
    raise failed


def main() -> None:
    """The worker: do the jobs that the parent orders, until it has none left or has died."""
    channel = open_parent(int(sys.argv[1]))
    logging.getLogger("ibrobot").setLevel(logging.ERROR)  # what a run says of itself is not that of the evaluation
    parent = os.getppid()
    with suppress(ComponentFailed):  # the parent is gone
        while True:
            for order in channel.wait(None):
                if "policy" not in order:
                    continue  # the first message, which orders nothing
                try:
                    _do(Job.of(order), parent)
                except Exception as error:  # noqa: BLE001 - a bug in a plugin is reported like an error
                    code = error.exit_code if isinstance(error, IbrobotError) else 1
                    channel.report(Failure(error_text(error), code))
                    channel.flush()
                    return
                channel.send({"done": order["seed"]})


def _do(job: Job, parent: int) -> None:
    """Do a job, unless the parent dies meanwhile: another evaluation may own the folder then."""
    out = Path(job.out)

    def go_on() -> bool:
        return os.getppid() == parent

    if job.document:
        run_episode(out, job.policy, job.seed, job.document, go_on)
    else:
        place = Place.of(out, job.policy, job.seed)
        film(place.video, job.policy, Result.read(place.result), go_on)


if __name__ == "__main__":
    main()

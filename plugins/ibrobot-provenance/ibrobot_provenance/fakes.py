"""Minimal implementations of the kinds that this package defines, for tests and for new packages."""

from __future__ import annotations

import json
import multiprocessing
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Any, override

import numpy as np
from numpy.typing import NDArray

from ibrobot_core.api import Context, DatasetError, Feature
from ibrobot_core.app import ComponentFailed, RequestError
from ibrobot_provenance.datasets import DatasetWriter
from ibrobot_provenance.jobs import Done, Job, Pool
from ibrobot_provenance.reports import ReportSection, Table, Text


class FakeDataset(DatasetWriter):
    """Writes each episode to `episode_N.npz`: one array per feature, and the tasks."""

    def __init__(self, ctx: Context) -> None:
        self._root: Path | None = None
        self._features: Mapping[str, Feature] = {}
        self._frames: list[dict[str, NDArray[np.generic]]] = []
        self._episodes = 0

    @override
    def create(self, root: Path, fps: float, features: Mapping[str, Feature], metadata: Mapping[str, Any]) -> None:
        if root.exists() and any(root.iterdir()):
            raise DatasetError(f"{root} is not empty")
        root.mkdir(parents=True, exist_ok=True)
        (root / "metadata.json").write_text(json.dumps({"fps": fps, **metadata}))
        self._root, self._features = root, features

    @override
    def add_frame(self, values: Mapping[str, NDArray[np.generic]], task: str) -> None:
        if self._root is None:
            raise DatasetError("create comes before add_frame")
        for key in sorted(self._features.keys() ^ values.keys()):
            raise DatasetError(f"{key} is {'missing' if key in self._features else 'not a feature of this dataset'}")
        for key, feature in self._features.items():
            if values[key].shape != feature.shape:
                raise DatasetError(f"{key} must have shape {feature.shape}, got {values[key].shape}")
        self._frames.append({key: np.array(value) for key, value in values.items()} | {"task": np.array(task)})

    @override
    def save_episode(self) -> int:
        if self._root is None or not self._frames:
            raise DatasetError("the episode has no frames")
        columns = {key: np.stack([frame[key] for frame in self._frames]) for key in self._frames[0]}
        np.savez(self._root / f"episode_{self._episodes}.npz", **columns)  # type: ignore[arg-type]
        self._frames = []
        self._episodes += 1
        return self._episodes - 1

    @override
    def finalize(self) -> None:
        self._frames = []


class FakePool(Pool):
    """Each job has a process of its own, which ends with it.

    Args:
        jobs: number of jobs at a time; None for one.
    """

    tries = 3
    """Number of processes that may die with the same job."""

    def __init__(self, jobs: int | None) -> None:
        self._limit = jobs or 1

    @override
    def run[R](self, jobs: Iterable[Job[R]], watch: Callable[[int], None] = lambda count: None) -> Generator[Done[R]]:
        todo, finished, running = map(_Task, jobs), 0, list[_Task]()
        try:
            while True:
                while len(running) < self._limit and (task := next(todo, None)) is not None:
                    running.append(task)
                    task.begin()
                if not running:
                    return
                ready = wait([task.pipe for task in running])
                for task in [task for task in running if task.pipe in ready]:
                    try:
                        counted, outcome = task.pipe.recv()
                    except EOFError:
                        task.end()
                        task.deaths += 1
                        task.progress = 0
                        if task.deaths < self.tries:
                            task.begin()
                            continue
                        counted, outcome = 0, (None, ComponentFailed(f"{self.tries} processes died with it"))
                    task.progress += counted
                    watch(finished + sum(each.progress for each in running))
                    if outcome is not None:
                        running.remove(task)
                        finished += task.progress
                        task.end()
                        yield Done(task.job, *outcome)
        finally:
            for task in running:
                task.end()


class _Task:
    """A job, and its process."""

    def __init__(self, job: Job[Any]) -> None:
        self.job = job
        self.deaths = self.progress = 0
        self._process: SpawnProcess | None = None

    def begin(self) -> None:
        """Start a process that does the job."""
        context = multiprocessing.get_context("spawn")
        self.pipe, theirs = context.Pipe(duplex=False)
        self._process = context.Process(target=_work, args=(self.job, theirs), daemon=True)
        with theirs:
            self._process.start()

    def end(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.join()
            self._process.close()
            self.pipe.close()
            self._process = None


def _work(job: Job[Any], pipe: Connection) -> None:
    """Do a job in this process; send progress, and at the end the result and the error."""
    outcome = job.run(lambda count: pipe.send((count, None)))
    pipe.send((0, outcome))


def fake_lines(folder: Path) -> Sequence[str]:
    """The result of a folder in one line.

    Raises:
        RequestError: if the folder has no results.
    """
    return [f"{_count(folder)} of the results are good"]


def fake_report(folder: Path) -> Sequence[ReportSection]:
    """The report on a folder.

    Raises:
        RequestError: if the folder has no results.
    """
    table = Table(("result", "number"), (("good", str(_count(folder))),))
    return [ReportSection("Results", (*(Text(line, "verdict") for line in fake_lines(folder)), table))]


def _count(folder: Path) -> int:
    """The number in the file `fake.json` of a folder."""
    file = folder / "fake.json"
    try:
        return int(json.loads(file.read_bytes())["good"])
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise RequestError(f'{file}: must be JSON as {{"good": 3}}: {error}') from None

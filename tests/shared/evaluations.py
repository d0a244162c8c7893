"""Evaluations in tests: a small arm, a pool without processes, and the process from which pools start theirs."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from multiprocessing import forkserver, set_forkserver_preload
from typing import Any, override

import pytest
from ibrobot_provenance.jobs import Done, Job, Pool

from ibrobot_core.app import installed_plugins

MINI = """\
robot:
  name: mini
  joints:
    - {name: pan, lower: -1.0, upper: 1.0, max_velocity: 2.0, max_acceleration: 10.0}
    - {name: grip, lower: -1.0, upper: 1.0, max_velocity: 2.0, max_acceleration: 10.0}
  groups: {all: [pan, grip]}
simulation: {type: reach}
executors:
  all_position: {type: position, group: all}
"""
"""The beginning of the YAML of an arm of two joints, simulated by `reach`."""
LIBRARIES = ("mujoco", "rosbags.typesys.stores.ros2_jazzy", "scipy.spatial.transform", "mcap.writer", "av", "coal")
"""Those of an episode, which each of its processes would otherwise import for itself."""


@contextmanager
def ready_forkserver() -> Iterator[None]:
    """The process that starts those of the pool outlives a test, and has imported what they need.

    One that earlier tests have started has imported what they had, or nothing: its processes take seconds to begin, and
    longer on a busy machine.
    """
    server: Any = forkserver._forkserver  # nothing public ends one
    server._stop()
    installed_plugins()
    needed = ("ibrobot_core.cli.main", "ibrobot_eval.evaluation", "ibrobot_testing.fakes", *LIBRARIES)
    # Of other plugins the packages alone: what reads the installed plugins when it is imported would not see the site.
    plugins = (name for name in sys.modules if name.startswith("ibrobot_") and "." not in name)
    set_forkserver_preload([*needed, *plugins])
    forkserver.ensure_running()
    yield
    server._stop()
    forkserver.ensure_running()  # for conversions in later tests, in which a new one would be a leak


class Here(Pool):
    """Runs jobs in this process, which is quick."""

    @override
    def run[R](self, jobs: Iterable[Job[R]], watch: Callable[[int], None] = lambda count: None) -> Generator[Done[R]]:
        for job in jobs:
            yield Done(job, *job.run(lambda count: None))


@contextmanager
def episodes_here(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Evaluations run their episodes in this process."""
    monkeypatch.setattr("ibrobot_eval.evaluation.open_pool", lambda *_: Here())
    log, requests = logging.getLogger("ibrobot"), logging.getLogger("ibrobot.inference")
    level, filters = log.level, [*requests.filters]
    yield
    log.setLevel(level)  # an episode makes both quiet, for its process
    requests.filters[:] = filters

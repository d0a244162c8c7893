"""Trains several policies, for seeds or other settings, as the jobs of a pool."""

from __future__ import annotations

import itertools
import sys
from collections.abc import Callable, Iterable
from contextlib import closing
from pathlib import Path

import attrs

from ibrobot_core.api import DatasetError
from ibrobot_core.app import Event, Failed, Job, echo, emit, installed_plugins
from ibrobot_lerobot import TRAIN
from ibrobot_lerobot.trainer import progress, run_training
from ibrobot_lerobot.training import Phase, Report, TrainOptions

_KEPT = "interrupted; the newest checkpoints are kept: the same command continues from there"


def trainings(options: TrainOptions) -> list[TrainOptions]:
    """The trainings of a command: one for each combination of the values of `each`."""
    named = [
        [f"{key}={value}" for value in values.split(",")] for key, _, values in (e.partition("=") for e in options.each)
    ]
    found = []
    for chosen in itertools.product(*named):
        out = options.out / ",".join(chosen) if chosen else options.out
        passed = (*options.lerobot_options, *(f"--{each}" for each in chosen))
        found.append(attrs.evolve(options, out=out, lerobot_options=passed, each=(), on=""))
    return found


def train_several(options: TrainOptions, *, events: bool) -> None:
    """Train all; exits with 1 if some fail, and then keeps the others."""
    jobs = [Job(train_in_pool, each, gpus=1) for each in trainings(options)]
    failed = 0
    limit = options.jobs or (None if options.on else 1)
    try:
        with closing(installed_plugins().pool(options.on, limit)) as pool, closing(pool.run(jobs)) as finished:
            for number, done in enumerate(finished, 1):
                failed += done.error is not None
                text = f"{done.job.argument.out}: {done.error or 'trained'} ({number} of {len(jobs)})"
                tell(text, Phase(text), events=events, err=done.error is not None)
    except KeyboardInterrupt:
        tell(_KEPT, Failed(_KEPT), events=events, err=True)
        sys.exit(130)
    if failed:
        text = f"{failed} of {len(jobs)} trainings failed; the same command continues with them"
        tell(text, Failed(text), events=events, err=True)
        sys.exit(1)
    if events:
        emit(TRAIN, Report(str(options.out)))


def tell(text: str, event: Event, *, events: bool, err: bool = False) -> None:
    """Print an event for the program that started the command, or text for a terminal."""
    if events:
        emit(TRAIN, event)
    else:
        echo(text, err=err)


def train_in_pool(options: TrainOptions, count: Callable[[int], None]) -> Path:
    """Train one policy, with the trainer's output in a file beside its folder; returns the checkpoint."""
    log = options.out.with_name(f"{options.out.name}.log")
    log.parent.mkdir(parents=True, exist_ok=True)

    def follow(output: Iterable[str], begun: int, steps: int) -> None:
        step, reports = begun, 0
        with log.open("a", encoding="utf-8") as file:
            for line in output:
                file.write(line)
                file.flush()
                if found := progress(line, reports, steps, begun):
                    reports += 1
                    count(found[0] - step)
                    step = found[0]

    code, newest = run_training(options, follow)
    if code or newest is None:
        raise DatasetError(f"the training failed: see {log}")
    return newest.policy

"""`ibrobot train`: trains policies by `lerobot-train`, with the settings of the tutorial, and reports the progress.

Several policies, for seeds or other settings, are the jobs of a pool.
"""

from __future__ import annotations

import itertools
import re
import time
from collections.abc import Callable, Iterable
from contextlib import closing
from functools import partial
from pathlib import Path

import attrs
from ibrobot_provenance.jobs import Job, open_pool
from ibrobot_terminal.plural import counted

from ibrobot_core.api import DatasetError
from ibrobot_core.app import Emit, Event, Failed, Unsuccessful, echo, wrong_input
from ibrobot_lerobot.trainer import INTERRUPTED, progress, run_training, saving_step
from ibrobot_lerobot.training import Begin, Phase, Progress, Report, TrainOptions
from ibrobot_lerobot.training_checkpoints import TrainingCheckpoint

_PHASES = {
    "Creating dataset": "opening the dataset",
    "Creating policy": "making the policy",
    "Start offline training": "training",
}
"""Text in the output of `lerobot-train` -> what it does from then on. Loading torch comes first."""
_ERROR = re.compile(r"(?:\w+\.)*\w*(?:Error|Exception)\b(?::|$)")
"""The last line of a traceback."""
_LONGEST_CAUSE = 500
_KEPT = "interrupted; the newest checkpoints are kept: the same command continues from there"


@attrs.frozen(kw_only=True)
class Train(TrainOptions):
    """Train a policy on a DATASET with LeRobot, which must be installed.

    The same command continues a training that was interrupted, from its newest checkpoint.
    LEROBOT_OPTIONS are passed to lerobot-train, e.g. --seed=1. With --each seed=1,2,3 it trains a policy for each of
    these seeds, in folders below --out.
    """

    @wrong_input()
    def __call__(self, emit: Emit) -> None:
        if self.each or self.on:
            train_several(self, emit)
            return
        causes: list[str] = []
        code, newest = run_training(self, partial(_report, emit, causes) if emit is not None else None)
        if code or newest is None:
            first = self.save_every or saving_step(self.steps)
            what = "interrupted" if code == INTERRUPTED else ": ".join(["the training failed", *causes[-1:]])
            _tell_end(what, newest, first, emit)
            raise Unsuccessful(exit_code=code or 1)
        trained = self.out / "checkpoints" / "last" / newest.policy.name
        tell(f"trained: {trained}", Report(str(trained)), emit)


def _tell_end(text: str, newest: TrainingCheckpoint | None, first: int, emit: Emit) -> None:
    """Tell what is kept of a training that has ended early, after why it has."""
    if newest is None:
        text += f"; nothing is kept, since the first checkpoint would have been written at step {first}"
    else:
        text += f"; kept: {newest.folder} (step {newest.step}); the same command continues from there"
    tell(text, Failed(text.replace("the same command", "the same training")), emit, err=True)


def _report(emit: Callable[[Event], None], causes: list[str], output: Iterable[str], begun: int, steps: int) -> None:
    """Print the progress as events, and all other lines as they are; `causes` gets the errors among them."""
    begin, reports = time.monotonic(), 0
    first: tuple[int, float] | None = None
    """Step and time [s] of the first report, before which LeRobot loads."""
    emit(Begin(begun, steps))
    emit(Phase("loading torch and LeRobot"))
    for line in output:
        for text in (text for mark, text in _PHASES.items() if mark in line):
            emit(Phase(text))
        if (event := progress(line, reports, steps, begun)) is None:
            echo(line.rstrip("\n"), err=True)
            causes += [line.strip()[:_LONGEST_CAUSE]] * (_ERROR.match(line) is not None)
            continue
        reports += 1
        step, loss, rate = event
        seconds, left_s = round(time.monotonic() - begin, 1), None
        if first is None:
            first = step, seconds
        elif step > first[0]:
            left_s = round((seconds - first[1]) / (step - first[0]) * (steps - step), 1)
        emit(Progress(step=step, steps=steps, loss=loss, lr=rate, seconds=seconds, left_s=left_s))


def trainings(options: TrainOptions) -> list[TrainOptions]:
    """The trainings of a command: one for each combination of the values of `each`."""
    named = [
        [f"{key}={value}" for value in values.split(",")] for key, _, values in (e.partition("=") for e in options.each)
    ]
    runs = []
    for chosen in itertools.product(*named):
        out = options.out / ",".join(chosen) if chosen else options.out
        passed = (*options.lerobot_options, *(f"--{each}" for each in chosen))
        runs.append(attrs.evolve(options, out=out, lerobot_options=passed, each=(), on=""))
    return runs


def train_several(options: TrainOptions, emit: Emit) -> None:
    """Train all; exits with 1 if some fail, and then keeps the others."""
    jobs = [Job(train_in_pool, each, gpus=1) for each in trainings(options)]
    failed = 0
    limit = options.jobs or (None if options.on else 1)
    try:
        with closing(open_pool(options.on, limit)) as pool, closing(pool.run(jobs)) as finished:
            for number, done in enumerate(finished, 1):
                failed += done.error is not None
                text = f"{done.job.argument.out}: {done.error or 'trained'} ({number} of {len(jobs)})"
                tell(text, Phase(text), emit, err=done.error is not None)
    except KeyboardInterrupt:
        tell(_KEPT, Failed(_KEPT), emit, err=True)
        raise Unsuccessful(exit_code=INTERRUPTED) from None
    if failed:
        text = f"{failed} of {counted(len(jobs), 'training')} failed; the same command continues with them"
        tell(text, Failed(text), emit, err=True)
        raise Unsuccessful
    if emit is not None:
        emit(Report(str(options.out)))


def tell(text: str, event: Event, emit: Emit, *, err: bool = False) -> None:
    """Print an event for the program that started the command, or text for a terminal."""
    if emit is not None:
        emit(event)
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
                if event := progress(line, reports, steps, begun):
                    reports += 1
                    count(event[0] - step)
                    step = event[0]

    code, newest = run_training(options, follow)
    if code or newest is None:
        raise DatasetError(f"the training failed: see {log}")
    return newest.policy

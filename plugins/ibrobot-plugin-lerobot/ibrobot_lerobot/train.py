"""`ibrobot train`: trains a policy by `lerobot-train`, with the settings of the tutorial, and reports the progress."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable

import click

from ibrobot_core.app import Failed, declared, echo, emit, wrong_input
from ibrobot_lerobot import TRAIN
from ibrobot_lerobot.several import tell, train_several
from ibrobot_lerobot.trainer import INTERRUPTED, progress, run_training, saving_step
from ibrobot_lerobot.training import Begin, Phase, Progress, Report, TrainOptions
from ibrobot_lerobot.training_checkpoints import TrainingCheckpoint

_PHASES = {
    "Creating dataset": "opening the dataset",
    "Creating policy": "making the policy",
    "Start offline training": "training",
}
"""Text in the output of `lerobot-train` -> what it does from then on. Loading torch comes first."""


@click.command(context_settings={"ignore_unknown_options": True})
@declared(TRAIN)
@wrong_input()
def train(options: TrainOptions, events: bool) -> None:
    """Train a policy on a DATASET with LeRobot, which must be installed.

    The same command continues a training that was interrupted, from its newest checkpoint.
    LEROBOT_OPTIONS are passed to lerobot-train, e.g. --seed=1. With --each seed=1,2,3 it trains a policy for each of
    these seeds, in folders below --out.
    """
    if options.each or options.on:
        train_several(options, events=events)
        return
    code, newest = run_training(options, _report if events else None)
    if code or newest is None:
        first = options.save_every or saving_step(options.steps)
        _tell_end(newest, first, interrupted=code == INTERRUPTED, events=events)
        sys.exit(code or 1)
    trained = options.out / "checkpoints" / "last" / newest.policy.name
    tell(f"trained: {trained}", Report(str(trained)), events=events)


def _tell_end(newest: TrainingCheckpoint | None, first: int, *, interrupted: bool, events: bool) -> None:
    """Tell what is kept of a training that has ended early."""
    text = "interrupted" if interrupted else "the training failed"
    if newest is None:
        text += f"; nothing is kept, since the first checkpoint would have been written at step {first}"
    else:
        text += f"; kept: {newest.folder} (step {newest.step}); the same command continues from there"
    tell(text, Failed(text.replace("the same command", "the same training")), events=events, err=True)


def _report(output: Iterable[str], begun: int, steps: int) -> None:
    """Print the progress as events, and all other lines as they are."""
    begin, reports = time.monotonic(), 0
    first: tuple[int, float] | None = None
    """Step and time [s] of the first report, before which LeRobot loads."""
    emit(TRAIN, Begin(begun, steps))
    emit(TRAIN, Phase("loading torch and LeRobot"))
    for line in output:
        for text in (text for mark, text in _PHASES.items() if mark in line):
            emit(TRAIN, Phase(text))
        if (found := progress(line, reports, steps, begun)) is None:
            echo(line.rstrip("\n"), err=True)
            continue
        reports += 1
        step, loss, rate = found
        seconds, left_s = round(time.monotonic() - begin, 1), None
        if first is None:
            first = step, seconds
        elif step > first[0]:
            left_s = round((seconds - first[1]) / (step - first[0]) * (steps - step), 1)
        emit(TRAIN, Progress(step=step, steps=steps, loss=loss, lr=rate, seconds=seconds, left_s=left_s))

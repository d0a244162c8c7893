"""`ibrobot train`: trains a policy by `lerobot-train`, with the settings of the tutorial, and reports the progress."""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import click

from ibrobot_core.api import DatasetError
from ibrobot_core.app import Failed, declared, echo, emit, owned, wrong_input
from ibrobot_lerobot import TRAIN
from ibrobot_lerobot.pretrained import check_policy
from ibrobot_lerobot.training import AUTO, SMALL, Begin, Phase, Progress, Report, TrainOptions, find_trainer
from ibrobot_lerobot.training_checkpoints import TrainingCheckpoint, begun_in_vain, check_same, newest_checkpoint

_SMALL = (
    "--policy.type=act", "--policy.use_vae=false", "--policy.dim_model=128", "--policy.n_heads=4",
    "--policy.dim_feedforward=256", "--policy.n_encoder_layers=2", "--policy.dropout=0.0", "--policy.chunk_size=30",
    "--policy.n_action_steps=30", "--use_policy_training_preset=false", "--optimizer.type=adamw",
    "--optimizer.lr=5e-4", "--optimizer.weight_decay=1e-4", "--scheduler.type=cosine_annealing_with_warmup",
    "--scheduler.num_warmup_steps=100",
)  # fmt: skip
_NORMALISED = {"VISUAL": "MEAN_STD", "STATE": "MEAN_STD", "ENV": "MEAN_STD", "ACTION": "MEAN_STD"}
"""LeRobot's ACT does not normalise ENV, the poses of objects in metres, which it would hardly see then."""
_PHASES = {
    "Creating dataset": "opening the dataset",
    "Creating policy": "making the policy",
    "Start offline training": "training",
}
"""Text in the output of `lerobot-train` -> what it does from then on. Loading torch comes first."""
type Follow = Callable[[Iterable[str], int, int], None]
"""Receives the lines of the trainer, the step that it begins with, and its last step."""
_REPORTS = 200
"""Reports of progress in a training."""
_END_S = 10.0
_INTERRUPTED = 130
_WHEN_CONTINUING = ("--policy.device", "--steps", "--save_freq", "--log_freq", "--output_dir")
"""Arguments of a command that continues a training; LeRobot takes the others from the checkpoint."""
_WATCH = "import os, signal, sys; sys.stdin.read(); os.killpg(0, signal.SIGKILL)"
"""Ends the trainer and its workers when this process has died, however that happened."""
_PROGRESS = re.compile(r"\bstep:\S+ .*?\bloss:(?P<loss>[-+.\deinfa]+)(?:.*?\blr:(?P<lr>[-+.\de]+))?")


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
        from ibrobot_lerobot.several import train_several

        train_several(options, events=events)
        return
    code, newest = run_training(options, _report if events else None)
    if code or newest is None:
        first = options.save_every or saving_step(options.steps)
        _tell_end(newest, first, interrupted=code == _INTERRUPTED, events=events)
        sys.exit(code or 1)
    trained = options.out / "checkpoints" / "last" / newest.policy.name
    if events:
        emit(TRAIN, Report(str(trained)))
    else:
        echo(f"trained: {trained}")


def run_training(options: TrainOptions, follow: Follow | None) -> tuple[int, TrainingCheckpoint | None]:
    """Begin a training, or continue it.

    Args:
        options: what to train.
        follow: reads the trainer's output; without it, the output goes to the terminal.

    Returns:
        The trainer's exit code, and the newest checkpoint.

    Raises:
        IbrobotError: e.g. if there is no dataset, or the folder has another training.
    """
    from ibrobot_lerobot.merge import reading

    dataset, out, policy, steps = options.dataset, options.out, options.policy, options.steps
    if not (dataset / "meta" / "info.json").is_file():
        raise DatasetError(f"{dataset}: is not a LeRobot dataset: it has no meta/info.json")
    program = find_trainer()
    given = (*arguments(options), *options.lerobot_options)
    chosen = list({each.partition("=")[0]: each for each in given}.values())  # of two for one option, the last counts
    with reading(dataset, "is being trained on"), owned(out, "is being trained", DatasetError):
        newest = _begun(out, chosen)
        if newest is None:
            if policy != SMALL:
                check_policy(policy, options.lerobot_options, download=options.download, on_page=follow is not None)
            command = [program, *chosen]
        else:
            kept = [each for each in chosen if each.partition("=")[0] in _WHEN_CONTINUING]
            command = [program, f"--config_path={newest.settings}", "--resume=true", *kept]
        begun = 0 if newest is None else newest.step
        if begun >= steps:
            return 0, newest
        if follow is None:
            echo(f"$ {shlex.join(command)}", err=True)
        code = _run(command, _environment(policy, download=options.download), begun, steps, follow)
        return code, newest_checkpoint(out)


def _environment(policy: str, *, download: bool) -> dict[str, str]:
    environment = {**os.environ, "OMP_WAIT_POLICY": "PASSIVE"}
    if not download:
        environment |= {"HF_HUB_OFFLINE": "1"}
    if policy == SMALL:  # one thread is the fastest for so small a network
        environment |= {"OMP_NUM_THREADS": "1"}
    return environment


def _begun(out: Path, chosen: Sequence[str]) -> TrainingCheckpoint | None:
    """The checkpoint from which a command continues; None for a new training.

    Raises:
        DatasetError: if the folder has another training, or something else.
    """
    if not out.exists():
        return None
    newest = newest_checkpoint(out)
    if newest is not None:
        check_same(newest, chosen)
        return newest
    if not out.is_dir() or not begun_in_vain(out):
        raise DatasetError(f"{out}: exists already, and is not a training to continue; choose a new folder")
    shutil.rmtree(out)
    return None


def _tell_end(newest: TrainingCheckpoint | None, first: int, *, interrupted: bool, events: bool) -> None:
    """Tell what is kept of a training that has ended early."""
    text = "interrupted" if interrupted else "the training failed"
    if newest is None:
        text += f"; nothing is kept, since the first checkpoint would have been written at step {first}"
    else:
        text += f"; kept: {newest.folder} (step {newest.step}); the same command continues from there"
    if events:
        emit(TRAIN, Failed(text.replace("the same command", "the same training")))
    else:
        echo(text, err=True)


def saving_step(steps: int) -> int:
    """The steps between two checkpoints, unless the user chooses: a tenth of all."""
    return max(1, steps // 10)


def arguments(options: TrainOptions) -> list[str]:
    """The arguments of `lerobot-train` for a new training."""
    small = [*_SMALL, f"--policy.normalization_mapping={json.dumps(_NORMALISED)}"]
    root, steps = options.dataset.resolve(), options.steps
    return [
        f"--dataset.repo_id=local/{root.name}", f"--dataset.root={root}",
        *(small if options.policy == SMALL else [f"--policy.type={options.policy}"]),
        *([] if options.device == AUTO else [f"--policy.device={options.device}"]), "--policy.push_to_hub=false",
        f"--batch_size={options.batch_size}", f"--steps={steps}",
        f"--save_freq={options.save_every or saving_step(steps)}",
        f"--log_freq={max(1, steps // _REPORTS)}", "--num_workers=0", "--wandb.enable=false",
        f"--output_dir={options.out.resolve()}",
    ]  # fmt: skip


def progress(line: str, reports: int, steps: int, begun: int = 0) -> tuple[int, float | None, float | None] | None:
    """Step, loss and learning rate that a line of `lerobot-train` reports; None if it reports none.

    Args:
        line: the line.
        reports: number of reports before this one. LeRobot writes steps as `step:2K`, so they are counted.
        steps: steps of the training.
        begun: the step from which it continues.
    """
    found = _PROGRESS.search(line)
    if found is None:
        return None
    every = max(1, steps // _REPORTS)
    step = min(steps, (begun // every + reports + 1) * every)
    loss, rate = float(found["loss"]), found["lr"]
    return step, loss if math.isfinite(loss) else None, float(rate) if rate else None


def _run(command: Sequence[str], environment: Mapping[str, str], begun: int, steps: int, follow: Follow | None) -> int:
    """Run `lerobot-train` from step `begun`, until Ctrl-C or the death of this process. Returns its exit code."""
    # A group of its own: Ctrl-C in the terminal reaches this process alone, which then ends the training.
    watch = subprocess.Popen([sys.executable, "-c", _WATCH], stdin=subprocess.PIPE, process_group=0)
    process = subprocess.Popen(
        command, env=environment, stdin=subprocess.DEVNULL, process_group=watch.pid, text=True, errors="replace",
        stdout=subprocess.PIPE if follow else None, stderr=subprocess.STDOUT if follow else None,
    )  # fmt: skip
    try:
        if process.stdout is not None and follow is not None:
            follow(process.stdout, begun, steps)
        return process.wait()
    except KeyboardInterrupt:
        process.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(_END_S)
        return _INTERRUPTED
    finally:
        watch.communicate()  # ends what is left of the group
        process.wait()
        if process.stdout is not None:
            process.stdout.close()


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
        seconds = round(time.monotonic() - begin, 1)
        left_s = None
        if first is None:
            first = step, seconds
        elif step > first[0]:
            left_s = round((seconds - first[1]) / (step - first[0]) * (steps - step), 1)
        emit(TRAIN, Progress(step=step, steps=steps, loss=loss, lr=rate, seconds=seconds, left_s=left_s))

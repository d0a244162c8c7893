"""Runs `lerobot-train` from its beginning or from a checkpoint, and reads its progress."""

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
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

from ibrobot_provenance.ownership import owned
from ibrobot_provenance.recorded_names import CARD

from ibrobot_core.api import DatasetError, IbrobotError
from ibrobot_core.app import echo, installed_plugins
from ibrobot_lerobot.layout import existing_dataset
from ibrobot_lerobot.pretrained import check_policy
from ibrobot_lerobot.training import AUTO, SMALL, TrainOptions, find_trainer
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
type Follow = Callable[[Iterable[str], int, int], None]
"""Receives the lines of the trainer, the step that it begins with, and its last step."""
_REPORTS = 200
"""Reports of progress in a training."""
_END_S = 10.0
INTERRUPTED = 130
_MAKES_CARDS = "datasets card"
"""The command that makes a card of a dataset."""
_WHEN_CONTINUING = ("--policy.device", "--steps", "--save_freq", "--log_freq", "--output_dir")
"""Arguments of a command that continues a training; LeRobot takes the others from the checkpoint."""
_WATCH = "import os, signal, sys; sys.stdin.read(); os.killpg(0, signal.SIGKILL)"
"""Ends the trainer and its workers when this process has died, however that happened."""
_PROGRESS = re.compile(r"\bstep:\S+ .*?\bloss:(?P<loss>[-+.\deinfa]+)(?:.*?\blr:(?P<lr>[-+.\de]+))?")


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
    source = existing_dataset(dataset)
    if not source.is_current:
        raise DatasetError(
            f"{dataset}: LeRobot does not train on so old a version of its format; `ibrobot datasets merge {dataset} "
            f"--out {dataset}-v3` copies it to v3.0"
        )
    program = find_trainer()
    given = (*arguments(options), *options.lerobot_options)
    chosen = list({each.partition("=")[0]: each for each in given}.values())  # of two for one option, the last counts
    with reading(dataset, "is being trained on"), owned(out, "is being trained", DatasetError):
        newest = _begun(out, chosen)
        if newest is None:
            if policy != SMALL or source.cameras:  # without cameras, the small ACT has nothing to download
                kind = "act" if policy == SMALL else policy
                check_policy(kind, options.lerobot_options, download=options.download, on_page=follow is not None)
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
        newest = newest_checkpoint(out)
        if newest is not None and newest.step > begun:
            _write_card(options, newest)
        return code, newest


def _write_card(options: TrainOptions, newest: TrainingCheckpoint) -> None:
    """Write the card of the data beside the checkpoint, if a plugin offers the command for it."""
    command = installed_plugins().commands.get(_MAKES_CARDS)
    if command is None:
        return
    facts = {
        "policy": options.policy, "step": newest.step, "steps": options.steps, "batch_size": options.batch_size,
        "dataset": options.dataset.resolve().name,
    }  # fmt: skip
    try:
        command.options(dataset=options.dataset, out=newest.policy / CARD, trained=json.dumps(facts))()
    except (IbrobotError, SystemExit) as error:  # the training itself is done
        echo(f"no card of the data was written beside the checkpoint: {error}", err=True)


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
        f"--log_freq={max(1, steps // _REPORTS)}", "--num_workers=0",
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
    match = _PROGRESS.search(line)
    if match is None:
        return None
    every = max(1, steps // _REPORTS)
    step = min(steps, (begun // every + reports + 1) * every)
    loss, rate = float(match["loss"]), match["lr"]
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
        return INTERRUPTED
    finally:
        watch.communicate()  # ends what is left of the group
        process.wait()
        if process.stdout is not None:
            process.stdout.close()

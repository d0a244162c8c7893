"""`ibrobot train`: trains a policy by `lerobot-train`, with the settings of the tutorial, and reports the progress."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import click

from ibrobot_core.api import DatasetError, MissingDependency
from ibrobot_core.app import Ownership, echo, wrong_input
from ibrobot_lerobot.pretrained import check_policy
from ibrobot_lerobot.training_checkpoints import TrainingCheckpoint, begun_in_vain, check_same, newest_checkpoint

LEROBOT = "lerobot[dataset,training]>=0.6.1,<0.7"
SMALL = "small_act"
"""The policy of the tutorial: an ACT with 0.5 million parameters, for a CPU."""
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
"""Text in the output of `lerobot-train` -> what it does from then on, for events. Loading torch comes first."""
_REPORTS = 200
"""Reports of progress in a training."""
_END_S = 10.0
_INTERRUPTED = 130
AUTO = "auto"
_WHEN_CONTINUING = ("--policy.device", "--steps", "--save_freq", "--log_freq", "--output_dir")
"""Arguments of a command that continues a training; LeRobot takes the others from the checkpoint."""
_WATCH = "import os, signal, sys; sys.stdin.read(); os.killpg(0, signal.SIGKILL)"
"""Ends the trainer and its workers when this process has died, however that happened."""
_PROGRESS = re.compile(r"\bstep:\S+ .*?\bloss:(?P<loss>[-+.\deinfa]+)(?:.*?\blr:(?P<lr>[-+.\de]+))?")


@click.command(context_settings={"ignore_unknown_options": True})
@click.argument("dataset", type=click.Path(path_type=Path))
@click.argument("options", nargs=-1, type=click.UNPROCESSED)
@click.option("--out", required=True, type=click.Path(path_type=Path), help="Folder for the checkpoints.")
@click.option("--policy", default=SMALL, show_default=True, help="small_act, or a policy type of LeRobot, e.g. act.")
@click.option("--steps", type=click.IntRange(min=1), default=5000, show_default=True, help="Training steps.")
@click.option("--batch-size", type=click.IntRange(min=1), default=32, show_default=True, help="Frames per step.")
@click.option("--save-every", type=click.IntRange(min=1), help="Steps between checkpoints; a tenth of all by default.")
@click.option("--device", default=AUTO, show_default=True, help="Device of torch: auto (a GPU if there is one), cpu, …")
@click.option("--download", is_flag=True, help="Let LeRobot download the weights that the policy begins with.")
@click.option("--events", is_flag=True, help="Print the progress as JSON lines.")
@wrong_input()
def train(
    dataset: Path, options: tuple[str, ...], out: Path, policy: str, steps: int, batch_size: int,
    save_every: int | None, device: str, download: bool, events: bool,
) -> None:  # fmt: skip
    """Train a policy on a DATASET with LeRobot, which must be installed.

    The same command continues a training that was interrupted, from its newest checkpoint.
    Further OPTIONS are passed to lerobot-train, e.g. --seed=1.
    """
    from ibrobot_lerobot.merge import reading

    if not (dataset / "meta" / "info.json").is_file():
        raise DatasetError(f"{dataset}: is not a LeRobot dataset: it has no meta/info.json")
    program = _program()
    chosen = [*arguments(dataset, out, policy, steps, batch_size, save_every, device), *options]
    with reading(dataset, "is being trained on"), _owning(out):
        newest = _begun(out, chosen)
        if newest is None:
            if policy != SMALL:
                check_policy(policy, options, download=download)
            command = [program, *chosen]
        else:
            kept = [each for each in chosen if each.partition("=")[0] in _WHEN_CONTINUING]
            command = [program, f"--config_path={newest.settings}", "--resume=true", *kept]
        begun = 0 if newest is None else newest.step
        if begun < steps:
            if not events:
                echo(f"$ {shlex.join(command)}", err=True)
            code = _run(command, _environment(policy, download=download), begun, steps, events=events)
            newest = newest_checkpoint(out)
            if code or newest is None:
                echo(_kept(newest, save_every or saving_step(steps), interrupted=code == _INTERRUPTED), err=True)
                sys.exit(code or 1)
    assert newest is not None
    trained = out / "checkpoints" / "last" / newest.policy.name
    echo(json.dumps({"event": "report", "checkpoint": str(trained)}) if events else f"trained: {trained}")


def _environment(policy: str, *, download: bool) -> dict[str, str]:
    environment = {**os.environ, "OMP_WAIT_POLICY": "PASSIVE"}
    if not download:
        environment |= {"HF_HUB_OFFLINE": "1"}
    if policy == SMALL:  # one thread is the fastest for so small a network
        environment |= {"OMP_NUM_THREADS": "1"}
    return environment


@contextlib.contextmanager
def _owning(out: Path) -> Iterator[None]:
    """A context in which no other training writes into `out`.

    Raises:
        InUse: if one does.
        DatasetError: if `out` cannot be locked.
    """
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        owned = Ownership(out, "is being trained")
    except OSError as error:
        raise DatasetError(f"{out}: cannot be written: {error.strerror}") from error
    with owned:
        yield


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


def _kept(newest: TrainingCheckpoint | None, first: int, *, interrupted: bool) -> str:
    """What is kept of a training that has ended early."""
    ended = "interrupted" if interrupted else "the training failed"
    if newest is None:
        return f"{ended}; nothing is kept, since the first checkpoint would have been written at step {first}"
    return f"{ended}; kept: {newest.folder} (step {newest.step}); the same command continues from there"


def saving_step(steps: int) -> int:
    """The steps between two checkpoints, unless the user chooses: a tenth of all."""
    return max(1, steps // 10)


def arguments(
    dataset: Path, out: Path, policy: str, steps: int, batch_size: int, save_every: int | None, device: str
) -> list[str]:
    """The arguments of `lerobot-train` for a new training."""
    chosen = [*_SMALL, f"--policy.normalization_mapping={json.dumps(_NORMALISED)}"]
    return [
        f"--dataset.repo_id=local/{dataset.resolve().name}", f"--dataset.root={dataset.resolve()}",
        *(chosen if policy == SMALL else [f"--policy.type={policy}"]),
        *([] if device == AUTO else [f"--policy.device={device}"]), "--policy.push_to_hub=false",
        f"--batch_size={batch_size}", f"--steps={steps}", f"--save_freq={save_every or saving_step(steps)}",
        f"--log_freq={max(1, steps // _REPORTS)}", "--num_workers=0", "--wandb.enable=false",
        f"--output_dir={out.resolve()}",
    ]  # fmt: skip


def progress(line: str, reports: int, steps: int, begun: int = 0) -> dict[str, Any] | None:
    """The progress that a line of `lerobot-train` reports; None if it reports none.

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
    rate = found["lr"]
    return {"step": step, "steps": steps, "loss": float(found["loss"]), "lr": float(rate) if rate else None}


def _program() -> str:
    beside = Path(sys.executable).with_name("lerobot-train")
    found = str(beside) if beside.exists() else shutil.which("lerobot-train")
    if found is None:
        raise MissingDependency("LeRobot is not installed", remedy=f"pip install '{LEROBOT}'")
    return found


def _run(command: Sequence[str], environment: Mapping[str, str], begun: int, steps: int, *, events: bool) -> int:
    """Run `lerobot-train` from step `begun`, until Ctrl-C or the death of this process. Returns its exit code."""
    # A group of its own: Ctrl-C in the terminal reaches this process alone, which then ends the training.
    watch = subprocess.Popen([sys.executable, "-c", _WATCH], stdin=subprocess.PIPE, process_group=0)
    process = subprocess.Popen(
        command, env=environment, stdin=subprocess.DEVNULL, process_group=watch.pid, text=True, errors="replace",
        stdout=subprocess.PIPE if events else None, stderr=subprocess.STDOUT if events else None,
    )  # fmt: skip
    try:
        if process.stdout is not None:
            _report(process.stdout, begun, steps)
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


def _report(output: Any, begun: int, steps: int) -> None:
    """Print the progress as events, and all other lines as they are."""
    begin, reports = time.monotonic(), 0
    echo(json.dumps({"event": "begin", "step": begun, "steps": steps}))
    echo(json.dumps({"event": "phase", "text": "loading torch and LeRobot"}))
    for line in output:
        for text in (text for mark, text in _PHASES.items() if mark in line):
            echo(json.dumps({"event": "phase", "text": text}))
        if (found := progress(line, reports, steps, begun)) is None:
            echo(line.rstrip("\n"), err=True)
            continue
        reports += 1
        echo(json.dumps({"event": "progress", **found, "seconds": round(time.monotonic() - begin, 1)}))

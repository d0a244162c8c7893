"""`ibrobot train`: trains a policy by `lerobot-train`, with the settings of the tutorial, and reports the progress."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import click

from ibrobot_core.api import DatasetError, MissingDependency, echo, wrong_input

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
_REPORTS = 200
"""Reports of progress in a training."""
_END_S = 10.0
_PROGRESS = re.compile(r"\bstep:\S+ .*?\bloss:(?P<loss>[-+.\deinfa]+)(?:.*?\blr:(?P<lr>[-+.\de]+))?")


@click.command(context_settings={"ignore_unknown_options": True})
@click.argument("dataset", type=click.Path(path_type=Path))
@click.argument("options", nargs=-1, type=click.UNPROCESSED)
@click.option("--out", required=True, type=click.Path(path_type=Path), help="New folder for the checkpoints.")
@click.option("--policy", default=SMALL, show_default=True, help="small_act, or a policy type of LeRobot, e.g. act.")
@click.option("--steps", type=click.IntRange(min=1), default=5000, show_default=True, help="Training steps.")
@click.option("--batch-size", type=click.IntRange(min=1), default=32, show_default=True, help="Frames per step.")
@click.option("--device", default="cpu", show_default=True, help="Device of torch: cpu, cuda, mps, …")
@click.option("--events", is_flag=True, help="Print the progress as JSON lines.")
@wrong_input()
def train(
    dataset: Path, options: tuple[str, ...], out: Path, policy: str, steps: int, batch_size: int, device: str,
    events: bool,
) -> None:  # fmt: skip
    """Train a policy on a DATASET with LeRobot, which must be installed.

    Further OPTIONS are passed to lerobot-train, e.g. --save_freq=1000.
    """
    if not (dataset / "meta" / "info.json").is_file():
        raise DatasetError(f"{dataset}: is not a LeRobot dataset: it has no meta/info.json")
    if out.exists():
        raise DatasetError(f"{out}: exists already; choose a new folder")
    command = [_program(), *arguments(dataset, out, policy, steps, batch_size, device), *options]
    environment = {**os.environ, "OMP_WAIT_POLICY": "PASSIVE"}
    if policy == SMALL:  # one thread is the fastest for so small a network
        environment |= {"HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1"}
    if not events:
        echo(f"$ {' '.join(command)}", err=True)
    code = _run(command, environment, steps, events=events)
    if code:
        sys.exit(code)
    checkpoint = out / "checkpoints" / "last" / "pretrained_model"
    if events:
        echo(json.dumps({"event": "report", "checkpoint": str(checkpoint)}))
    else:
        echo(f"trained: {checkpoint}")


def arguments(dataset: Path, out: Path, policy: str, steps: int, batch_size: int, device: str) -> list[str]:
    """The arguments of `lerobot-train`."""
    chosen = [*_SMALL, f"--policy.normalization_mapping={json.dumps(_NORMALISED)}"]
    return [
        f"--dataset.repo_id=local/{dataset.resolve().name}", f"--dataset.root={dataset}",
        *(chosen if policy == SMALL else [f"--policy.type={policy}"]),
        f"--policy.device={device}", "--policy.push_to_hub=false", f"--batch_size={batch_size}", f"--steps={steps}",
        f"--save_freq={steps}", f"--log_freq={max(1, steps // _REPORTS)}", "--num_workers=0", "--wandb.enable=false",
        f"--output_dir={out}",
    ]  # fmt: skip


def progress(line: str, reports: int, steps: int) -> dict[str, Any] | None:
    """The progress that a line of `lerobot-train` reports; None if it reports none.

    Args:
        line: the line.
        reports: number of reports before this one. LeRobot writes steps as `step:2K`, so they are counted.
        steps: steps of the training.
    """
    found = _PROGRESS.search(line)
    if found is None:
        return None
    step = min(steps, (reports + 1) * max(1, steps // _REPORTS))
    rate = found["lr"]
    return {"step": step, "steps": steps, "loss": float(found["loss"]), "lr": float(rate) if rate else None}


def _program() -> str:
    beside = Path(sys.executable).with_name("lerobot-train")
    found = str(beside) if beside.exists() else shutil.which("lerobot-train")
    if found is None:
        raise MissingDependency("LeRobot is not installed", remedy=f"pip install '{LEROBOT}'")
    return found


def _run(command: Sequence[str], environment: Mapping[str, str], steps: int, *, events: bool) -> int:
    """Run `lerobot-train`; Ctrl-C ends it too. Returns its exit code."""
    process = subprocess.Popen(
        command, env=environment, stdin=subprocess.DEVNULL, start_new_session=True, text=True, errors="replace",
        stdout=subprocess.PIPE if events else None, stderr=subprocess.STDOUT if events else None,
    )  # fmt: skip
    try:
        if process.stdout is not None:
            _report(process.stdout, steps)
        return process.wait()
    except KeyboardInterrupt:
        echo("interrupted; the last checkpoint is kept", err=True)
        os.killpg(process.pid, signal.SIGTERM)
        return 130
    finally:
        try:
            process.wait(_END_S if process.poll() is None else 0)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        if process.stdout is not None:
            process.stdout.close()


def _report(output: Any, steps: int) -> None:
    """Print the progress as events, and all other lines as they are."""
    begin, reports = time.monotonic(), 0
    echo(json.dumps({"event": "begin", "steps": steps}))
    for line in output:
        if (found := progress(line, reports, steps)) is None:
            echo(line.rstrip("\n"), err=True)
            continue
        reports += 1
        echo(json.dumps({"event": "progress", **found, "seconds": round(time.monotonic() - begin, 1)}))

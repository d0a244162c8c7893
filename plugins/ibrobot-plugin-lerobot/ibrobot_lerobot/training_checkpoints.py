"""The checkpoints that a training of LeRobot has written, and whether a command continues it."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import attrs
from safetensors import SafetensorError, safe_open

from ibrobot_core.api import DatasetError

_ELSEWHERE = ("policy.device", "log_freq", "num_workers", "steps", "save_freq", "output_dir", "wandb.enable")
"""Settings that may differ between the commands of one training."""


@attrs.frozen
class TrainingCheckpoint:
    """A complete checkpoint, from which LeRobot continues."""

    folder: Path
    step: int

    @property
    def policy(self) -> Path:
        """The folder of the trained policy."""
        return self.folder / "pretrained_model"

    @property
    def settings(self) -> Path:
        """The settings of the training, as LeRobot wrote them."""
        return self.policy / "train_config.json"


def newest_checkpoint(out: Path) -> TrainingCheckpoint | None:
    """The newest complete checkpoint of a training; None if there is none.

    LeRobot moves the link `last` when a checkpoint is complete. If the link is missing, it was killed during the first
    save or while it moved the link; the files then show whether a checkpoint is complete.
    """
    folder = out / "checkpoints"
    last = folder / "last"
    folders = [last.resolve()] if last.exists() else sorted(filter(Path.is_dir, folder.glob("*")), reverse=True)
    return next((each for path in folders if (each := _read(folder / path.name)) is not None), None)


def _read(folder: Path) -> TrainingCheckpoint | None:
    """A checkpoint, or None if it is not complete."""
    state = folder / "training_state"
    try:
        checkpoint = TrainingCheckpoint(folder, int(json.loads((state / "training_step.json").read_bytes())["step"]))
        settings = json.loads(checkpoint.settings.read_bytes())
        if settings.get("scheduler") is not None:  # the last file that LeRobot writes
            json.loads((state / "scheduler_state.json").read_bytes())
        for file in (checkpoint.policy / "model.safetensors", state / "optimizer_state.safetensors"):
            with safe_open(file, "numpy"):  # refuses a file that is shorter than its head says
                pass
    except (OSError, ValueError, KeyError, TypeError, SafetensorError):
        return None
    return checkpoint


def begun_in_vain(out: Path) -> bool:
    """Whether `out` has only the remains of a training that ended before its first checkpoint."""
    inside = {path.name for path in out.iterdir()}
    return inside <= {"checkpoints"} and newest_checkpoint(out) is None


def check_same(checkpoint: TrainingCheckpoint, arguments: Sequence[str]) -> None:
    """Check that arguments of `lerobot-train` continue the training of a checkpoint.

    Raises:
        DatasetError: with the settings that differ.
    """
    settings = json.loads(checkpoint.settings.read_text(encoding="utf-8"))
    if differing := list(_differing(settings, arguments)):
        raise DatasetError(
            f"{checkpoint.folder.parents[1]}: has a training with other settings ({'; '.join(differing)}): repeat its "
            "command to continue it, or choose a new folder with --out"
        )


def _differing(settings: Any, arguments: Sequence[str]) -> Iterator[str]:
    for argument in arguments:
        key, _, text = argument.removeprefix("--").partition("=")
        if key in _ELSEWHERE:
            continue
        value = settings
        for part in key.split("."):
            value = value.get(part) if isinstance(value, dict) else None
        if not _equal(value, text):
            yield f"{key} is {json.dumps(value)}, not {text}"


def _equal(value: Any, text: str) -> bool:
    try:
        return bool(value == json.loads(text))
    except ValueError:
        return str(value) == text

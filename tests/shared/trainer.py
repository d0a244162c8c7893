"""A stand-in for `lerobot-train`, which takes its arguments, reads a dataset and writes checkpoints as LeRobot does.

Imported, `install` makes a program of it. More arguments: `--fail`, `--pause` between steps [s], and `--stop_at`, the
step at which it writes the file `--stopped` and waits to be killed.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

LINE = "INFO 19:45:10 ot_train.py:300 step:{step} smpl:2K ep:9 epch:0.10 loss:{loss} grdn:1.2 lr:5.0e-04 updt_s:0.1"
NOTHING = b"\2\0\0\0\0\0\0\0{}"
"""A safetensors file without tensors."""


def install(folder: Path) -> Path:
    """Write the program `lerobot-train` into a folder."""
    program = folder / "lerobot-train"
    program.write_text(f"#!{sys.executable}\n{Path(__file__).read_text(encoding='utf-8')}", encoding="utf-8")
    program.chmod(0o755)
    return program


def check_dataset(root: Path) -> None:
    """Check that a dataset is not half of another one."""
    import pyarrow.parquet as pq

    info = json.loads((root / "meta/info.json").read_bytes())
    for folder, wanted in (("data", info["total_frames"]), ("meta/episodes", info["total_episodes"])):
        rows = sum(pq.read_metadata(path).num_rows for path in (root / folder).rglob("*.parquet"))
        if rows != wanted:
            sys.exit(f"{root}/{folder}: has {rows} rows, not {wanted}")


def settings_of(given: Mapping[str, str]) -> dict[str, Any]:
    """The settings that LeRobot writes into a checkpoint."""
    settings: dict[str, Any] = {}
    for key, text in given.items():
        *folders, last = key.split(".")
        inner = settings
        for folder in folders:
            inner = inner.setdefault(folder, {})
        try:
            inner[last] = json.loads(text)
        except ValueError:
            inner[last] = text
    return settings


def save(out: Path, step: int, settings: Mapping[str, Any]) -> None:
    """Write a checkpoint, and then the link to it."""
    policy, state = (out / "checkpoints" / f"{step:06}" / name for name in ("pretrained_model", "training_state"))
    policy.mkdir(parents=True, exist_ok=True)
    (policy / "train_config.json").write_text(json.dumps(settings))
    state.mkdir(exist_ok=True)
    (state / "training_step.json").write_text(json.dumps({"step": step}))
    (state / "optimizer_state.safetensors").write_bytes(NOTHING)
    (policy / "model.safetensors").write_bytes(NOTHING)
    (state / "scheduler_state.json").write_text("{}")
    (out / "checkpoints/last").unlink(missing_ok=True)
    (out / "checkpoints/last").symlink_to(f"{step:06}")


def main() -> None:
    """Train for no result."""
    given = dict(each.removeprefix("--").partition("=")[::2] for each in sys.argv[1:])
    steps, every, saves = (int(given[name]) for name in ("steps", "log_freq", "save_freq"))
    out, begun = Path(given["output_dir"]), 0
    if "resume" in given:
        file = Path(given["config_path"])
        settings = json.loads(file.read_text())
        begun = json.loads((file.parents[1] / "training_state/training_step.json").read_text())["step"]
    else:
        out.mkdir(parents=True)
        settings = settings_of(given)
    print("WARNING no wandb")
    print("BEGUN", begun)
    print("INFO Creating dataset")
    check_dataset(Path(settings["dataset"]["root"]))
    print("INFO Start offline training on a fixed dataset")
    for step in range(begun + 1, steps + 1):
        time.sleep(settings.get("pause", 0.0))
        if step % every == 0:
            print(LINE.format(step=step, loss=1 / step), flush=True)
        if step % saves == 0 or step == steps:
            save(out, step, settings)
        if step == int(given.get("stop_at", 0)) and not begun:
            Path(given["stopped"]).write_text("")
            time.sleep(60)
    if "fail" in given:
        print("Traceback (most recent call last):", "torch.OutOfMemoryError: CUDA out of memory", sep="\n")
    sys.exit(7 * ("fail" in given))


if __name__ == "__main__":
    main()

"""`ibrobot train` with a fake `lerobot-train`, and `ibrobot datasets info`."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from ibrobot_lerobot import train as training
from ibrobot_lerobot.commands import datasets
from ibrobot_lerobot.train import arguments, progress, train

from ibrobot_core.api import DatasetError, Feature, MissingDependency

from .conftest import CAMERA, FPS, write

FEATURES = {"observation.state": Feature("float32", (2,), ("a.pos", "b.pos")), "observation.images.top": CAMERA}
LINE = "INFO 19:45:10 ot_train.py:300 step:{step} smpl:2K ep:9 epch:0.10 loss:{loss} grdn:1.2 lr:5.0e-04 updt_s:0.1"
PROGRAM = f"""#!{sys.executable}
import sys
steps = next(int(each.partition("=")[2]) for each in sys.argv if each.startswith("--steps="))
every = next(int(each.partition("=")[2]) for each in sys.argv if each.startswith("--log_freq="))
print("WARNING no wandb")
for step in range(every, steps + 1, every):
    print({LINE!r}.format(step=step, loss=1 / step))
raise SystemExit(7 * ("--fail" in sys.argv))
"""


def run(command: Any, *words: object, code: int = 0) -> list[str]:
    result = CliRunner().invoke(command, [str(word) for word in words])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == code, result.output
    return result.output.splitlines()


def test_a_dataset_shows_counts_units_and_statistics(tmp_path: Path):
    root = write(tmp_path / "set", FEATURES, (3, 40), codec="h264")
    facts = json.loads("\n".join(run(datasets, "info", root, "--json")))
    assert (facts["episodes"], facts["frames"], facts["fps"]) == (2, 43, FPS)
    state, top = facts["features"]
    assert (state["names"], len(state["stats"]["mean"]), top["picture"]) == (["a.pos", "b.pos"], 2, True)
    assert len(top["stats"]["max"]) == 3
    assert [each["frames"] for each in facts["list"]] == [3, 40]
    assert any("b.pos" in line for line in run(datasets, "info", root))
    with pytest.raises(DatasetError, match=r"is not a LeRobot dataset: it has no meta/info\.json"):
        run(datasets, "info", tmp_path)


def test_training_reports_its_progress_as_events(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    root = write(tmp_path / "set", FEATURES, (3,), codec="h264")
    program = tmp_path / "lerobot-train"
    program.write_text(PROGRAM)
    program.chmod(0o755)
    monkeypatch.setattr(training, "_program", lambda: str(program))
    lines = run(train, root, "--out", tmp_path / "out", "--steps", 1000, "--events")
    events = [json.loads(line) for line in lines if line.startswith("{")]
    steps = [event for event in events if event["event"] == "progress"]
    assert (events[0], len(steps)) == ({"event": "begin", "steps": 1000}, 200)
    assert (steps[0]["step"], steps[-1]["step"], steps[-1]["loss"], steps[-1]["lr"]) == (5, 1000, 0.001, 5e-4)
    assert events[-1]["checkpoint"] == str(tmp_path / "out/checkpoints/last/pretrained_model")
    assert "WARNING no wandb" in lines
    run(train, root, "--out", tmp_path / "out", "--steps", 10, "--events", "--fail", code=7)


def test_a_training_without_lerobot_names_the_command_that_installs_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    root = write(tmp_path / "set", FEATURES, (3,), codec="h264")
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(MissingDependency, match=r"pip install 'lerobot\[dataset,training\]"):
        run(train, root, "--out", tmp_path / "out")
    with pytest.raises(DatasetError, match="exists already"):
        run(train, root, "--out", root)


def test_other_policies_keep_the_settings_of_lerobot():
    words = arguments(Path("set"), Path("out"), "diffusion", 100, 8, "cuda")
    assert {"--policy.type=diffusion", "--policy.device=cuda", "--steps=100", "--log_freq=1"} < set(words)
    assert not any(word.startswith("--optimizer") for word in words)
    assert progress("step:1 without numbers", 0, 10) is None

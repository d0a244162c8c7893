"""`ibrobot train` with a fake `lerobot-train`, and `ibrobot datasets info`."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import attrs
import pytest
from click.testing import CliRunner
from ibrobot_lerobot import merge as merging
from ibrobot_lerobot import trainer as lerobot_train
from ibrobot_lerobot.trainer import arguments, progress
from ibrobot_lerobot.training import EVENTS, Begin, Progress, Report, TrainOptions
from ibrobot_lerobot.training_checkpoints import newest_checkpoint
from ibrobot_provenance.asking import read_event
from ibrobot_provenance.ownership import InUse
from ibrobot_testing import ibrobot_command
from ibrobot_testing.command import command_line
from trainer import install

from ibrobot_core.api import DatasetError, Feature, MissingDependency
from ibrobot_core.app import RequestError, Shown

from .conftest import CAMERA, FPS, rows, write

FEATURES = {"observation.state": Feature("float32", (2,), ("a.pos", "b.pos")), "observation.images.top": CAMERA}

datasets, train = command_line("datasets"), command_line("train")


@pytest.fixture
def dataset(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A dataset; `ibrobot train` runs `trainer` in place of LeRobot's program."""
    program = install(tmp_path)
    monkeypatch.setattr(lerobot_train, "find_trainer", lambda: str(program))
    weights = tmp_path / "torch/hub/checkpoints/resnet18-stand_in.pth"  # an installed LeRobot would load them
    weights.parent.mkdir(parents=True)
    weights.touch()
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    return write(tmp_path / "set", FEATURES, (3,), codec="h264")


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


def test_training_reports_its_progress_as_events(dataset: Path, tmp_path: Path):
    lines = run(train, dataset, "--out", tmp_path / "out", "--steps", 1000, "--events")
    events = [json.loads(line) for line in lines if line.startswith("{")]
    steps = [event for event in events if event["event"] == "progress"]
    assert (events[0], len(steps)) == ({"event": "begin", "step": 0, "steps": 1000}, 200)
    assert (steps[0]["step"], steps[-1]["step"], steps[-1]["loss"], steps[-1]["lr"]) == (5, 1000, 0.001, 5e-4)
    assert events[-1]["checkpoint"] == str(tmp_path / "out/checkpoints/last/pretrained_model")
    phases = [event["text"] for event in events if event["event"] == "phase"]
    assert phases == ["loading torch and LeRobot", "opening the dataset", "training"]
    assert "WARNING no wandb" in lines
    failed = run(train, dataset, "--out", tmp_path / "other", "--steps", 10, "--events", "--fail=1", code=7)
    assert "the training failed: torch.OutOfMemoryError: CUDA out of memory; kept: " in json.loads(failed[-1])["error"]


def test_what_is_shown_of_a_training() -> None:
    assert Begin(0, 10).shown() == Shown("begins: 10 steps", 0.0)
    assert Begin(5, 10).shown() == Shown("continues from step 5 of 10 steps", 0.5)
    step = Progress(step=4, steps=10, loss=0.5, lr=None, seconds=360.0, left_s=120.0)
    text = "step 4 of 10, loss 0.5, about 2 min left"
    assert step.shown() == Shown(text, 0.4, point={"step": 4.0, "loss": 0.5})
    assert attrs.evolve(step, left_s=40.0).shown().text.endswith(", less than a minute left")
    assert attrs.evolve(step, left_s=None).shown().text == "step 4 of 10, loss 0.5"
    lost = attrs.evolve(step, loss=None).shown()
    assert (lost.point, "loss not finite" in lost.text) == ({}, True)
    assert Report("t/last").shown() == Shown("trained: t/last", 1.0, made={"policy": "t/last"})


def test_the_time_left_is_known_after_two_reports(dataset: Path, tmp_path: Path) -> None:
    lines = run(train, dataset, "--out", tmp_path / "out", "--steps", 10, "--events", "--pause=0.01")
    steps = [event for line in lines if isinstance(event := read_event(line, EVENTS), Progress)]
    assert [each.left_s is None for each in steps] == [True, *[False] * 9]
    assert steps[-1].left_s == 0.0


def test_training_saves_a_tenth_of_its_steps_apart(dataset: Path, tmp_path: Path):
    run(train, dataset, "--out", tmp_path / "out", "--steps", 1000)
    saved = sorted(path.name for path in (tmp_path / "out/checkpoints").iterdir())
    assert saved == [*(f"{step:06}" for step in range(100, 1001, 100)), "last"]
    run(train, dataset, "--out", tmp_path / "more", "--steps", 1000, "--save-every", 400)
    assert sorted(path.name for path in (tmp_path / "more/checkpoints").iterdir())[0] == "000400"


def test_each_seed_is_trained_in_a_folder_of_its_own(dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    words = ("train", dataset, "--out", out, "--steps", 20, "--each", "seed=1,2", "--each", "batch_size=4", "--jobs", 2)
    command = [*ibrobot_command(), *map(str, words)]
    environment = {**os.environ, "PATH": f"{tmp_path}{os.pathsep}{os.environ['PATH']}"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    for seed in (1, 2):
        name = f"seed={seed},batch_size=4"
        settings = json.loads((out / name / "checkpoints/last/pretrained_model/train_config.json").read_text())
        assert (settings["seed"], settings["batch_size"]) == (seed, 4)
        assert f"{out / name}: trained (" in done.stdout
        assert "step:20" in (out / f"{name}.log").read_text()
    again = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert (again.returncode, again.stdout.count("trained (")) == (0, 2), "what is trained is kept"
    command[command.index(str(out))] = str(tmp_path / "failing")
    failing = subprocess.run([*command, "--fail"], env=environment, capture_output=True, text=True, check=False)
    assert (failing.returncode, "2 of 2 trainings failed" in failing.stderr) == (1, True), failing.stderr
    assert f"the training failed: see {tmp_path / 'failing/seed=1,batch_size=4.log'}" in failing.stderr


def test_values_of_each_option_are_checked(dataset: Path, tmp_path: Path) -> None:
    with pytest.raises(RequestError, match="'seed' is no option with values"):
        run(train, dataset, "--out", tmp_path / "out", "--each", "seed")


def interrupted(
    dataset: Path, out: Path, stop_at: int, number: signal.Signals, meanwhile: Callable[[int], None] = lambda pid: None
) -> tuple[int, str, Callable[[], list[str]]]:
    """Begin a training of 100 steps, and end it at a step, after a call of `meanwhile` with its process.

    Returns:
        Exit code and standard error, and a function that runs the same command again.
    """
    stopped = dataset.parent / f"stopped-{stop_at}"
    words = ["--out", out, "--steps", 100, f"--stop_at={stop_at}", f"--stopped={stopped}"]
    command = (sys.executable, "-c", SCRIPT, str(dataset.parent / "lerobot-train"), str(dataset), *map(str, words))
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        while not stopped.exists():
            assert process.poll() is None
            time.sleep(0.01)
        meanwhile(process.pid)
        process.send_signal(number)
        _, errors = process.communicate()
    return process.returncode, errors, lambda: run(train, dataset, *words, "--events")


SCRIPT = """
import sys
from ibrobot_testing.command import command_line
from ibrobot_lerobot import merge as merging
from ibrobot_lerobot import train, trainer
trainer.find_trainer = lambda: sys.argv[1]
command_line("train").main(sys.argv[2:])
"""


@pytest.mark.parametrize(("stop_at", "kept"), [(5, 0), (57, 50), (90, 90)])
def test_interrupted_training_says_what_is_kept_and_continues_by_the_same_command(
    dataset: Path, tmp_path: Path, stop_at: int, kept: int
):
    out = tmp_path / "out"
    _, errors, again = interrupted(dataset, out, stop_at, signal.SIGINT)
    if kept:
        checkpoint = out / f"checkpoints/{kept:06}"
        assert f"interrupted; kept: {checkpoint} (step {kept}); the same command continues from there" in errors
    else:
        assert "interrupted; nothing is kept, since the first checkpoint would have been written at step 10" in errors
    if not kept:

        def again() -> list[str]:
            return run(train, dataset, "--out", out, "--steps", 100, "--events")

    lines = again()
    assert f"BEGUN {kept}" in lines
    events = [json.loads(line) for line in lines if line.startswith("{")]
    assert events[0] == {"event": "begin", "step": kept, "steps": 100}
    assert [event["step"] for event in events if event["event"] == "progress"] == list(range(kept + 1, 101))
    assert (out / "checkpoints/last/training_state/training_step.json").read_text() == '{"step": 100}'
    assert "BEGUN 0" not in again()  # it has ended: nothing runs, and the checkpoint is named again


def test_killed_train_takes_the_trainer_along(dataset: Path, tmp_path: Path):
    code, _, _ = interrupted(dataset, tmp_path / "out", 20, signal.SIGKILL)
    assert code == -signal.SIGKILL
    newest = newest_checkpoint(tmp_path / "out")  # its pipes were closed, so that the trainer that held them ended, too
    assert newest is not None
    assert newest.step == 20, "it did not go on to the end"


@pytest.mark.parametrize("stop_at", [5, 57], ids=["before a checkpoint", "after one"])
def test_a_training_has_its_folder_and_its_dataset_to_itself(
    dataset: Path, tmp_path: Path, stop_at: int, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(merging, "_WAIT_S", 0.0)
    out, part = tmp_path / "out", write(tmp_path / "part", FEATURES, (4,), codec="h264")
    before = list(rows(dataset))

    def meanwhile(pid: int) -> None:
        kept = sorted(out.rglob("*"))
        for words in (["--steps", 100], ["--steps", 10]):
            with pytest.raises(InUse, match=f"out: is being trained by process {pid}; try again"):
                run(train, dataset, "--out", out, *words)
        assert sorted(out.rglob("*")) == kept
        with pytest.raises(InUse, match=f"set: is being trained on by process {pid}; try again"):
            merging.merge(dataset, [part], {})
        assert list(rows(dataset)) == before
        run(train, dataset, "--out", tmp_path / "beside", "--steps", 10)  # another one may read the dataset, too

    interrupted(dataset, out, stop_at, signal.SIGKILL, meanwhile)
    merging.merge(dataset, [part], {})
    run(train, dataset, "--out", out, "--steps", 100)


def test_a_merge_that_was_interrupted_is_finished_before_a_training(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    part = write(tmp_path / "part", FEATURES, (4,), codec="h264")
    with monkeypatch.context() as patched:
        patched.setattr(Path, "replace", lambda self, target: (_ for _ in ()).throw(OSError(5, "Input/output error")))
        with pytest.raises(DatasetError, match="the merge cannot be completed"):
            merging.merge(dataset, [part], {})
    run(train, dataset, "--out", tmp_path / "out", "--steps", 10)
    assert json.loads((dataset / "meta/info.json").read_bytes())["total_episodes"] == 2
    assert not list(dataset.glob(".*"))


def test_training_with_other_settings_is_refused_and_kept(dataset: Path, tmp_path: Path):
    out = tmp_path / "out"
    run(train, dataset, "--out", out, "--steps", 10)
    with pytest.raises(
        DatasetError, match=r"has a training with other settings \(batch_size is 32, not 64\): repeat its "
    ):
        run(train, dataset, "--out", out, "--steps", 10, "--batch-size", 64)
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "mine.txt").write_text("mine")
    with pytest.raises(DatasetError, match="exists already, and is not a training to continue; choose a new folder"):
        run(train, dataset, "--out", tmp_path / "notes", "--steps", 10)
    assert (tmp_path / "notes" / "mine.txt").read_text() == "mine"


def test_newest_checkpoint_is_found_without_its_link(dataset: Path, tmp_path: Path):
    out = tmp_path / "out"
    run(train, dataset, "--out", out, "--steps", 20)
    (out / "checkpoints/last").unlink()
    shutil.copytree(out / "checkpoints/000020", out / "checkpoints/000021")
    (out / "checkpoints/000021/training_state/optimizer_state.safetensors").write_bytes(
        b"\2\0\0"
    )  # killed in this save
    newest = newest_checkpoint(out)
    assert newest is not None
    assert (newest.step, newest.folder.name) == (20, "000020")


def test_a_training_without_lerobot_names_the_command_that_installs_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    root = write(tmp_path / "set", FEATURES, (3,), codec="h264")
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(MissingDependency, match=r"pip install \"lerobot\[dataset,training\]"):
        run(train, root, "--out", tmp_path / "out")


def test_other_policies_keep_the_settings_of_lerobot():
    asked = TrainOptions(dataset=Path("set"), out=Path("out"), policy="diffusion", steps=100, device="cuda")
    words = arguments(asked)
    assert not [word for word in words if "wandb" in word], "LeRobot 0.7 has no such option; in others it is off"
    assert {"--policy.type=diffusion", "--policy.device=cuda", "--steps=100", "--log_freq=1"} < set(words)
    small = arguments(TrainOptions(dataset=Path("set"), out=Path("out"), steps=100, save_every=7))
    assert not any(word.startswith("--policy.device") for word in small)  # LeRobot takes a GPU if there is one
    assert "--save_freq=7" in small
    assert not any(word.startswith("--optimizer") for word in words)
    assert progress("step:1 without numbers", 0, 10) is None

"""`ibrobot train` with LeRobot itself: killed and continued, and refused where it could not start."""

from __future__ import annotations

import json
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from ibrobot_lerobot.options import LeRobotOptions
from ibrobot_lerobot.training_checkpoints import newest_checkpoint
from ibrobot_lerobot.writer import LeRobotDatasetWriter
from ibrobot_testing import ibrobot_command
from ibrobot_testing.command import command_line

from ibrobot_core.api import Feature, MissingDependency

train = command_line("train")

pytestmark = pytest.mark.lerobot
STEPS = 12
FEATURES = {
    "observation.state": Feature("float32", (2,), ("a.pos", "b.pos")),
    "observation.environment_state": Feature("float32", (2,), ("x", "y")),
    "action": Feature("float32", (2,), ("a.pos", "b.pos")),
}


@pytest.fixture
def small_dataset(tmp_path: Path) -> Path:
    """Two episodes without images."""
    writer = LeRobotDatasetWriter(LeRobotOptions())
    writer.create(tmp_path / "set", 30, FEATURES, {"robot_type": "tester"})
    for _ in range(2):
        for number in range(40):
            writer.add_frame({key: np.full(2, number, np.float32) for key in FEATURES}, "wait")
        writer.save_episode()
    writer.finalize()
    return tmp_path / "set"


def refused(dataset: Path, out: Path, *words: str) -> str:
    result = CliRunner().invoke(train, [str(dataset), "--out", str(out), *words])
    assert isinstance(result.exception, MissingDependency), result.output
    assert not out.exists()
    return str(result.exception)


def test_policy_that_would_download_weights_is_refused_before_it_starts(
    small_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path / "hub"))
    message = refused(small_dataset, tmp_path / "out", "--policy", "act")
    assert message == (
        "policy act begins with pretrained weights that are not on this machine: pretrained_backbone_weights is "
        "ResNet18_Weights.IMAGENET1K_V1; --download lets LeRobot fetch them; without a network, "
        "--policy.pretrained_backbone_weights=null begins with random weights"
    )
    message = refused(small_dataset, tmp_path / "out", "--policy", "smolvla")
    assert "vlm_model_name is HuggingFaceTB/SmolVLM2-500M-Video-Instruct" in message
    message = refused(small_dataset, tmp_path / "out", "--policy", "xvl")
    assert "'xvl' is not a policy type of LeRobot" in message
    assert "did you mean 'xvla'?" in message


def test_small_act_with_cameras_is_refused_before_it_would_download_weights(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    writer = LeRobotDatasetWriter(LeRobotOptions(videos=False))
    camera = Feature("image", (8, 8, 3), ("height", "width", "channels"))
    writer.create(tmp_path / "seen", 30, FEATURES | {"observation.images.top": camera}, {"robot_type": "tester"})
    state = {key: np.zeros(2, np.float32) for key in FEATURES}
    writer.add_frame(state | {"observation.images.top": np.zeros((8, 8, 3), np.uint8)}, "wait")
    writer.save_episode()
    writer.finalize()
    message = refused(tmp_path / "seen", tmp_path / "out")
    assert "pretrained_backbone_weights is ResNet18_Weights.IMAGENET1K_V1" in message


def test_policy_whose_extra_is_missing_is_refused_before_it_starts(small_dataset: Path, tmp_path: Path) -> None:
    message = refused(small_dataset, tmp_path / "out", "--policy", "groot")
    assert message.startswith("policy groot needs ")
    assert message.endswith('not installed; pip install "lerobot[groot]"')


def ended(output: list[str]) -> list[dict[str, object]]:
    return [json.loads(line) for line in output if line.startswith("{")]


@pytest.mark.parametrize(
    ("when", "number"),
    [
        pytest.param(lambda out: True, signal.SIGKILL, marks=pytest.mark.long),
        (lambda out: (out / "checkpoints/000003/pretrained_model").exists(), signal.SIGKILL),
        pytest.param(lambda out: newest_checkpoint(out) is not None, signal.SIGINT, marks=pytest.mark.long),
    ],
    ids=["while torch loads", "in the first save", "after a checkpoint"],
)
def test_killed_training_continues_to_the_same_number_of_steps(
    small_dataset: Path, tmp_path: Path, when: Callable[[Path], bool], number: signal.Signals
) -> None:
    out = tmp_path / "out"
    command = [
        *ibrobot_command(), "train", str(small_dataset), "--out", str(out), "--steps", str(STEPS), "--save-every", "3",
        "--batch-size", "2", "--events",
    ]  # fmt: skip
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        process.stdout.readline()
        while not when(out):
            assert process.poll() is None
            time.sleep(0.05)
        process.send_signal(number)
        output, _ = process.communicate()
    kept = newest_checkpoint(out) if out.exists() else None
    if number == signal.SIGINT:
        assert kept is not None
        said = f"interrupted; kept: {kept.folder} (step {kept.step}); the same training continues from there"
        assert ended(output.splitlines())[-1] == {"event": "failed", "error": said}
    again = subprocess.run(command, capture_output=True, text=True, check=False)
    assert again.returncode == 0, again.stderr
    events = ended(again.stdout.splitlines())
    assert events[0] == {"event": "begin", "step": kept.step if kept is not None else 0, "steps": STEPS}
    newest = newest_checkpoint(out)
    assert newest is not None
    assert newest.step == STEPS
    assert (newest.policy / "model.safetensors").is_file()

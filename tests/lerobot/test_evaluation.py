"""`lerobot-eval`, unmodified, and `ibrobot eval`: a policy has the same states and successes on the same seeds."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.act.configuration_act import ACTConfig

from ibrobot_core.api import Float64MultiArray, JointState
from ibrobot_core.app import installed_plugins

sys.path.insert(0, str(Path(__file__).parent))
from checkpoints import SCENE, SIZE, STATE, save
from command_line import run_here

pytestmark = pytest.mark.lerobot
EPISODES, SEED = 4, 3
# The goal is so large that the block lies on it at the beginning of some episodes, and the policy does not touch it.
OVERRIDES = ("contract.max_duration_s=1", "simulation.scene.goal_tolerance=0.1")


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A policy of random weights, which moves the arm above its rest pose."""
    inputs = {STATE: PolicyFeature(FeatureType.STATE, (SIZE,)), SCENE: PolicyFeature(FeatureType.ENV, (10,))}
    config = ACTConfig(
        input_features=inputs,
        output_features={"action": PolicyFeature(FeatureType.ACTION, (SIZE,))},
        device="cpu",
        dim_model=32,
        n_heads=2,
        dim_feedforward=32,
        n_encoder_layers=1,
        use_vae=False,
        chunk_size=8,
        n_action_steps=1,
        pretrained_backbone_weights=None,
    )
    joints = {"mean": np.array([0, -1.3, 1.2, 0.8, 0, 0.3], np.float32), "std": np.full(SIZE, 0.3, np.float32)}
    return save(config, tmp_path_factory.mktemp("policy") / "checkpoint", {STATE: joints, "action": joints})


@pytest.fixture(scope="module")
def ours(checkpoint: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of `ibrobot eval`."""
    out = tmp_path_factory.mktemp("ours") / "evaluation"
    model = f"models.push={{type: lerobot, path: {checkpoint}, n_action_steps: 1, device: cpu}}"
    dispatch = "control_modes.push.dispatch={watermark: 0, smoothing: {enabled: false}}"
    settings = ("simulation.scene=push", *OVERRIDES, model, dispatch)
    sets = [word for each in settings for word in ("--set", each)]
    counts = ("--episodes", str(EPISODES), "--seed", str(SEED), "--jobs", "1", "--videos", "0")
    done = run_here("eval", "so101_scenes", "--sim", "--mode", "push", *sets, *counts, "--out", out)
    assert done.returncode == 0, done.stderr
    return out


@pytest.fixture
def lerobot_eval(checkpoint: Path, lerobot_command: Callable[..., None], tmp_path: Path) -> Callable[..., Path]:
    """Runs LeRobot's command; returns its folder."""

    def run(episodes: int, seed: int, *more: str) -> Path:
        out = tmp_path / "theirs"
        lerobot_command(
            "eval",
            f"--policy.path={checkpoint}",
            "--policy.device=cpu",
            "--env.type=ibrobot",
            "--env.task=Push-v0",
            f"--env.overrides={json.dumps(OVERRIDES)}",
            f"--eval.n_episodes={episodes}",
            "--eval.batch_size=1",
            f"--seed={seed}",
            f"--output_dir={out}",
            *more,
        )
        return out

    return run


def test_successes_are_equal_seed_by_seed(ours: Path, lerobot_eval: Callable[..., Path]) -> None:
    theirs = json.loads((lerobot_eval(EPISODES, SEED) / "eval_info.json").read_text())
    (task,) = theirs["per_task"]
    episodes = json.loads((ours / "report.json").read_text())["episodes"]
    outcomes = [each["success"] for each in episodes]
    assert [each["seed"] for each in episodes] == [SEED + i for i in range(EPISODES)]
    assert set(outcomes) == {True, False}, "nothing is compared"
    assert task["metrics"]["successes"] == outcomes


@pytest.mark.long
def test_observations_are_equal_bit_by_bit(ours: Path, lerobot_eval: Callable[..., Path]) -> None:
    episodes = json.loads((ours / "report.json").read_text())["episodes"]
    seed = next(each["seed"] for each in episodes if not each["success"])  # a success ends its episode at once
    out = lerobot_eval(1, seed, "--eval.recording=true")
    rows = pq.read_table(next(out.rglob("data/**/*.parquet")))
    state, scene = (np.stack(rows[name].to_numpy()) for name in ("agent_pos", "environment_state"))
    reader = installed_plugins().open_episode(ours / "episodes" / "push" / f"seed_{seed:06d}")
    messages = [each.message for each in reader.messages(("/joint_states", "/simulation/scene"))]
    reader.close()
    joints = {m.header.stamp_ns: np.float32(m.position) for m in messages if isinstance(m, JointState)}
    objects = [np.float32(m.data) for m in messages if isinstance(m, Float64MultiArray)]
    ticks = [stamp_ns for stamp_ns in joints if any((joints[stamp_ns] == row).all() for row in state)]
    assert len(state) == 30
    np.testing.assert_array_equal(state, np.stack([joints[tick] for tick in ticks]))
    np.testing.assert_array_equal(scene, np.stack([objects[list(joints).index(tick)] for tick in ticks]))
    assert set(np.diff(ticks)) == {30_000_000, 40_000_000}, "the contract's ticks in periods of control"
    assert np.ptp(state, axis=0).max() > 0.1, "the arm did not move"

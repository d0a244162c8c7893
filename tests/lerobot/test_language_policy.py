"""A policy with a prompt, LeRobot's own tokeniser and real-time chunking: SmolVLA, with a tiny language model."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, override

import attrs
import numpy as np
import pytest
import torch
from ibrobot_lerobot.checkpoint import ACTION
from ibrobot_lerobot.options import LeRobotPolicyOptions
from ibrobot_lerobot.policy import SEED, LeRobotPolicy
from ibrobot_testing import PolicySuite
from ibrobot_testing.contexts import START_NS, host_context
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.factory import make_pre_post_processors
from lerobot.policies.pi0.configuration_pi0 import PI0Config
from lerobot.policies.pi05.configuration_pi05 import PI05Config
from lerobot.policies.rtc.configuration_rtc import RTCConfig
from lerobot.policies.utils import prepare_observation_for_inference
from lerobot.processor import tokenizer_processor

from ibrobot_core.errors import PolicyError
from ibrobot_core.interfaces import Frame

sys.path.insert(0, str(Path(__file__).parent))
from checkpoints import CHUNK, SIZE, STATE, TOP, Theirs, features, language_model, save, smolvla, statistics

pytestmark = [pytest.mark.lerobot, pytest.mark.filterwarnings("default")]  # transformers warns of its own


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("language")
    return save(smolvla(language_model(root / "vlm")), root / "smolvla")


def options(path: Path, language: Path | None = None) -> LeRobotPolicyOptions:
    """With leave to load the language model, which lies elsewhere."""
    language = language or path.parent / "vlm"
    return LeRobotPolicyOptions(path, threads=1, device="cpu", base_models=(str(language),))


@pytest.fixture(scope="module")
def policy(path: Path) -> Iterator[LeRobotPolicy]:
    torch.set_num_threads(1)
    policy = LeRobotPolicy(options(path), host_context())
    policy.load()
    yield policy
    policy.close()


def frame(prompt: str = "pick up the cube") -> Frame:
    rng = np.random.default_rng(4)
    values = {
        STATE: rng.uniform(-1, 1, SIZE).astype(np.float32),
        TOP: rng.integers(0, 256, (96, 96, 3), np.uint8),
    }
    return Frame(START_NS, values, prompt=prompt)


def test_a_prompt_gives_lerobots_chunk(path: Path, policy: LeRobotPolicy) -> None:
    theirs = Theirs(path)
    chunks = []
    for prompt in ("pick up the cube", "cube the up pick"):
        tensors = policy.preprocess(frame(prompt))
        assert all(value.dtype.kind in "biuf" for value in tensors.values())
        chunks.append(policy.postprocess(policy.infer(tensors)))
        wanted = theirs.chunk(frame().values, int(tensors[SEED][0]), prompt)
        np.testing.assert_array_equal(chunks[-1], wanted.astype(np.float64))
    assert not np.array_equal(chunks[0], chunks[1])


def test_the_plan_is_continued_as_lerobot_does(path: Path, policy: LeRobotPolicy) -> None:
    assert policy.spec.prefix
    prefix = np.random.default_rng(1).uniform(-0.5, 0.5, (5, SIZE))
    tensors = policy.preprocess(attrs.evolve(frame(), prefix=prefix, delay_steps=2))
    assert tensors["prefix"].shape == (1, 5, SIZE)
    ours = policy.postprocess(policy.infer(tensors))
    theirs = Theirs(path)
    theirs.policy.config.rtc_config = RTCConfig()
    theirs.policy.init_rtc_processor()
    batch = {**theirs.batch(frame().values, frame().prompt), ACTION: torch.from_numpy(prefix.astype(np.float32))[None]}
    left_over = theirs.pre({**batch, "task": frame().prompt})[ACTION]
    wanted = theirs.chunk(
        frame().values, int(tensors[SEED][0]), frame().prompt, inference_delay=2, prev_chunk_left_over=left_over
    )
    np.testing.assert_array_equal(ours, wanted.astype(np.float64))
    alone = policy.postprocess(policy.infer(policy.preprocess(frame())))
    assert np.abs(ours[:2] - prefix[:2]).mean() < 0.5 * np.abs(alone[:2] - prefix[:2]).mean()
    assert len(ours) == CHUNK


@pytest.mark.parametrize(
    ("prefix", "delay", "said"),
    [
        (np.zeros((1, 5, SIZE), np.float32), None, "delay_steps is missing"),
        (np.zeros((5, SIZE), np.float32), 2, "prefix is float32 (5, 6), must be float32 (1, -1, 6)"),
        (np.zeros((1, 5, SIZE), np.float32), 6, "0 <= delay_steps <= 5 <= 8 must hold"),
        (np.zeros((1, CHUNK + 1, SIZE), np.float32), 1, "0 <= delay_steps <= 9 <= 8 must hold"),
    ],
)
def test_an_invalid_plan_is_reported(policy: LeRobotPolicy, prefix: Any, delay: int | None, said: str) -> None:
    tensors = {**policy.preprocess(frame()), "prefix": prefix}
    if delay is not None:
        tensors["delay_steps"] = np.array([delay])
    with pytest.raises(PolicyError) as message:
        policy.infer(tensors)
    assert said in str(message.value)


@pytest.mark.parametrize("name", ["pi0", "pi05"])
def test_the_robots_side_of_pi0(name: str, path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its network is too large to make one here; its processors are not."""
    config = {"pi0": PI0Config, "pi05": PI05Config}[name](**features(STATE, TOP))
    step = tokenizer_processor.TokenizerProcessorStep
    monkeypatch.setattr(
        f"lerobot.policies.{name}.processor_{name}.TokenizerProcessorStep",
        lambda tokenizer_name, **options: step(tokenizer_name=str(path.parent / "vlm"), **options),
    )
    config.save_pretrained(tmp_path)
    for processor in make_pre_post_processors(config, dataset_stats=statistics()):
        processor.save_pretrained(tmp_path)
    policy = LeRobotPolicy(options(tmp_path, path.parent / "vlm"), host_context())
    assert (policy.spec.chunk_size, policy.spec.prompt, policy.spec.prefix) == (50, True, True)
    tensors = policy.preprocess(frame())
    pre, _ = make_pre_post_processors(PreTrainedConfig.from_pretrained(tmp_path), pretrained_path=str(tmp_path))
    values = {key: np.array(value) for key, value in frame().values.items()}
    wanted = pre(prepare_observation_for_inference(values, torch.device("cpu"), frame().prompt, "tester"))
    arrays = {key: value.numpy() for key, value in wanted.items() if isinstance(value, torch.Tensor)}
    assert len(arrays) == 4
    for key, array in arrays.items():
        np.testing.assert_array_equal(tensors[key], array)
    with pytest.raises(PolicyError, match="has no weights"):
        policy.load()


def test_steps_that_are_not_standard_are_said(path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO):
        LeRobotPolicy(options(path), host_context())
    assert "steps that only LeRobot runs, so this process loads torch" in caplog.text
    assert "smolvla_new_line_processor, tokenizer_processor" in caplog.text


class TestSmolVla(PolicySuite):
    @pytest.fixture(autouse=True)
    def _path(self, path: Path) -> None:
        self.path = path

    @override
    def make(self, ctx):
        return LeRobotPolicy(options(self.path), ctx)

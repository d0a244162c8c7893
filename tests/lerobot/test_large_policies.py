"""Policies whose networks are large: their own classes with few and small layers give LeRobot's chunks, bit by bit."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from ibrobot_lerobot.options import LeRobotPolicyOptions
from ibrobot_lerobot.policy import SEED, LeRobotPolicy
from ibrobot_testing.contexts import START_NS, host_context
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.multi_task_dit.configuration_multi_task_dit import MultiTaskDiTConfig
from lerobot.policies.pi0 import modeling_pi0
from lerobot.policies.pi0.configuration_pi0 import PI0Config
from lerobot.policies.pi05 import modeling_pi05
from lerobot.policies.pi05.configuration_pi05 import PI05Config
from lerobot.policies.xvla.configuration_xvla import XVLAConfig
from lerobot.processor import tokenizer_processor
from transformers import CLIPConfig, CLIPTextModel, CLIPVisionModel

from ibrobot_core.interfaces import Frame

sys.path.insert(0, str(Path(__file__).parent))
from checkpoints import CHUNK, SIZE, STATE, TOP, Theirs, features, language_model, save

pytestmark = [pytest.mark.lerobot, pytest.mark.filterwarnings("default")]  # transformers warns of its own
WORDS = 10
"""Of the tokeniser."""


def pi(name: str, language: Path, monkeypatch: pytest.MonkeyPatch) -> PreTrainedConfig:
    """Its configuration states no sizes: the network's own functions are replaced."""
    module: Any = {"pi0": modeling_pi0, "pi05": modeling_pi05}[name]
    whole = module.PaliGemmaForConditionalGenerationWithPiGemma

    def small(config: Any) -> Any:
        for key in ("hidden_size", "intermediate_size"):
            setattr(config.vision_config, key, 16)
        config.vision_config.num_hidden_layers, config.vision_config.num_attention_heads = 1, 2
        config.vision_config.projection_dim = config.text_config.hidden_size
        return whole(config)

    monkeypatch.setattr(module, "PaliGemmaForConditionalGenerationWithPiGemma", small)
    monkeypatch.setattr(module, "get_gemma_config", lambda variant: module.GemmaConfig(16, 2, 16, 2, 1, 8))
    step = tokenizer_processor.TokenizerProcessorStep
    monkeypatch.setattr(
        f"lerobot.policies.{name}.processor_{name}.TokenizerProcessorStep",
        lambda tokenizer_name, **options: step(tokenizer_name=str(language), **options),
    )
    kind: Any = {"pi0": PI0Config, "pi05": PI05Config}[name]
    few = {"chunk_size": CHUNK, "n_action_steps": CHUNK, "num_inference_steps": 2}
    config: PreTrainedConfig = kind(**features(STATE, TOP), image_resolution=(28, 28), **few)
    return config


def xvla(name: str, language: Path, monkeypatch: pytest.MonkeyPatch) -> PreTrainedConfig:
    vision = {
        "depths": [1, 1],
        "embed_dim": [8, 16],
        "num_heads": [2, 2],
        "num_groups": [2, 2],
        "patch_size": [7, 3],
        "patch_stride": [4, 2],
        "patch_padding": [3, 1],
        "patch_prenorm": [False, True],
        "window_size": 4,
        "projection_dim": 16,
    }
    text = {
        "d_model": 16,
        "encoder_layers": 1,
        "decoder_layers": 1,
        "encoder_attention_heads": 2,
        "decoder_attention_heads": 2,
        "encoder_ffn_dim": 16,
        "decoder_ffn_dim": 16,
        "vocab_size": WORDS + 10,
        "max_position_embeddings": 1024,
    }
    florence = {"vision_config": vision, "text_config": text, "projection_dim": 16, "vocab_size": WORDS + 10}
    small = {"hidden_size": 32, "depth": 1, "num_heads": 2, "len_soft_prompts": 2, "num_denoising_steps": 2}
    few = {"chunk_size": CHUNK, "n_action_steps": CHUNK, "tokenizer_max_length": 8, "num_image_views": 1}
    return XVLAConfig(
        florence_config=florence,
        tokenizer_name=str(language),
        action_mode="auto",
        **features(STATE, TOP),
        **small,
        **few,
    )


def multi_task_dit(name: str, language: Path, monkeypatch: pytest.MonkeyPatch) -> PreTrainedConfig:
    small = {"hidden_size": 16, "intermediate_size": 16, "num_hidden_layers": 1, "num_attention_heads": 2}
    path = language.with_name("clip")
    config = CLIPConfig(
        text_config={**small, "vocab_size": WORDS, "max_position_embeddings": 77, "eos_token_id": 1},
        vision_config={**small, "image_size": 32, "patch_size": 16},
    )
    torch.manual_seed(5)
    CLIPVisionModel(config.vision_config).save_pretrained(path)
    CLIPTextModel(config.text_config).save_pretrained(path.with_name("clip_text"))
    for file in language.glob("*token*"):
        (path.with_name("clip_text") / file.name).write_bytes(file.read_bytes())
    layers = {"hidden_dim": 32, "num_layers": 1, "num_heads": 2, "timestep_embed_dim": 16, "num_inference_steps": 3}
    return MultiTaskDiTConfig(
        vision_encoder_name=str(path), text_encoder_name=str(path.with_name("clip_text")), image_crop_shape=(32, 32),
        **features(STATE, TOP), **layers,
    )  # fmt: skip


LARGE: dict[str, Callable[[str, Path, pytest.MonkeyPatch], PreTrainedConfig]] = {
    "pi0": pi,
    "pi05": pi,
    "xvla": xvla,
    "multi_task_dit": multi_task_dit,
}


@pytest.mark.parametrize("name", sorted(LARGE))
def test_the_chunks_are_lerobots(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tqdm.tqdm.monitor_interval", 0)  # without a thread
    torch.set_num_threads(1)
    config = LARGE[name](name, language_model(tmp_path / "vlm"), monkeypatch)
    path = save(config, tmp_path / "checkpoint")
    models = tuple(str(tmp_path / each) for each in ("vlm", "clip", "clip_text"))
    policy = LeRobotPolicy(LeRobotPolicyOptions(path, threads=1, device="cpu", base_models=models), host_context())
    policy.load()
    theirs = Theirs(path)
    rng = np.random.default_rng(4)
    chunks = []
    for tick in range(3):
        values = {
            STATE: rng.uniform(-1, 1, SIZE).astype(np.float32),
            TOP: rng.integers(0, 256, (96, 96, 3), np.uint8),
        }
        prompt = ("pick up the cube", "cube the up pick")[tick % 2]
        tensors = policy.preprocess(Frame(START_NS + tick, values, prompt=prompt))
        chunks.append(policy.postprocess(policy.infer(tensors)))
        seed = int(tensors[SEED][0])
        if policy.spec.history:  # LeRobot keeps it from action to action
            theirs.policy.reset()
            wanted = np.stack([theirs.select(values, seed, prompt) for _ in chunks[-1]])
        else:
            wanted = theirs.chunk(values, seed, prompt)
        np.testing.assert_array_equal(chunks[-1], wanted.astype(np.float64))
    assert np.isfinite(chunks).all()
    assert not np.array_equal(chunks[0], chunks[1])
    policy.close()

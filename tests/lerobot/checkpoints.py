"""Small checkpoints of random weights, made and run by LeRobot itself."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any, override

import numpy as np
import torch
import torchvision
from draccus.wrappers import docstring
from ibrobot_testing.contexts import ARM, GRIPPER
from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import FeatureType, NormalizationMode, PolicyFeature
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.policies.smolvla.configuration_smolvla import SmolVLAConfig
from lerobot.policies.utils import prepare_observation_for_inference
from lerobot.policies.vqbet.configuration_vqbet import VQBeTConfig
from numpy.typing import NDArray
from torchvision.models.resnet import BasicBlock, ResNet

STATE, TOP, WRIST, SCENE = (
    "observation.state",
    "observation.images.top",
    "observation.images.wrist",
    "observation.environment_state",
)
SIZE = len(ARM + GRIPPER)
CHUNK = 8

_FEATURES = {
    STATE: PolicyFeature(FeatureType.STATE, (SIZE,)),
    TOP: PolicyFeature(FeatureType.VISUAL, (3, 96, 96)),
    WRIST: PolicyFeature(FeatureType.VISUAL, (3, 96, 96)),
    SCENE: PolicyFeature(FeatureType.ENV, (4,)),
}
_ACTION = {"action": PolicyFeature(FeatureType.ACTION, (SIZE,))}
_OF_TYPE = {STATE: FeatureType.STATE, TOP: FeatureType.VISUAL, WRIST: FeatureType.VISUAL, SCENE: FeatureType.ENV}


class NarrowResNet(ResNet):  # type: ignore[misc]  # torchvision is not installed where types are checked
    """Half of ResNet-18, with a quarter of its channels: less to draw, save, load, hash, export and multiply."""

    def __init__(self, weights: None = None, **options: Any) -> None:
        super().__init__(BasicBlock, [1, 1, 1, 1], **options)
        self.fc = torch.nn.Linear(self.inplanes, 1)

    @override
    def _make_layer(self, block: type[BasicBlock], planes: int, *arguments: Any, **options: Any) -> torch.nn.Module:
        return super()._make_layer(block, planes // 4, *arguments, **options)


# It reads the source of a configuration's class for the help text of each field, whenever one is loaded.
docstring.get_attribute_docstring = cache(docstring.get_attribute_docstring)
torchvision.models.resnet10_narrow = NarrowResNet
_BACKBONE = {"vision_backbone": "resnet10_narrow", "pretrained_backbone_weights": None}
EVERYWHERE = {"vision_backbone": "resnet18"}
"""Changes of a configuration whose checkpoint other processes load: their torchvision has no narrow one."""


def features(*keys: str) -> dict[str, Any]:
    """A configuration's features, on the CPU."""
    return {"input_features": {key: _FEATURES[key] for key in keys}, "output_features": _ACTION, "device": "cpu"}


def act(**changes: Any) -> ACTConfig:
    """Two cameras, state and scene."""
    small = {"dim_model": 32, "n_heads": 2, "dim_feedforward": 32, "n_encoder_layers": 1, "n_vae_encoder_layers": 1}
    steps = {"chunk_size": CHUNK, "n_action_steps": CHUNK}
    return ACTConfig(**(_BACKBONE | features(STATE, TOP, WRIST, SCENE) | small | steps | changes))


def diffusion(**changes: Any) -> DiffusionConfig:
    """Two cameras; three observations of history, and five of sixteen actions."""
    small = {"down_dims": (16, 32), "diffusion_step_embed_dim": 16, "spatial_softmax_num_keypoints": 4}
    steps = {"n_obs_steps": 3, "horizon": 16, "n_action_steps": 5, "num_inference_steps": 3, "n_groups": 4}
    return DiffusionConfig(**(_BACKBONE | features(STATE, TOP, WRIST) | small | steps | changes))


def vqbet(**changes: Any) -> VQBeTConfig:
    """One camera, five observations."""
    small = {
        "gpt_n_layer": 1,
        "gpt_n_head": 2,
        "gpt_hidden_dim": 32,
        "gpt_input_dim": 32,
        "gpt_output_dim": 32,
        "vqvae_embedding_dim": 16,
        "vqvae_enc_hidden_dim": 16,
        "offset_loss_weight": 1.0,
    }
    return VQBeTConfig(**(_BACKBONE | features(STATE, TOP) | small | {"crop_shape": (84, 84)} | changes))


CONFIGS = {"act": act, "diffusion": diffusion, "vqbet": vqbet}


def statistics(seed: int = 0) -> dict[str, dict[str, NDArray[np.float32]]]:
    """Of every kind that a mode of normalisation needs; one joint has not moved in the dataset."""
    rng = np.random.default_rng(seed)
    found = {}
    for key, shape in {STATE: (SIZE,), TOP: (3, 1, 1), WRIST: (3, 1, 1), SCENE: (4,), "action": (SIZE,)}.items():
        low, spread = rng.uniform(-1, 0, shape), rng.uniform(0.1, 1, shape)
        spread.flat[1] = 0.0
        quantiles = {"min": 0.0, "q01": 0.05, "q10": 0.2, "mean": 0.45, "q90": 0.8, "q99": 0.95, "max": 1.0}
        each = {name: low + spread * at for name, at in quantiles.items()} | {"std": spread / 4}
        found[key] = {name: value.astype(np.float32) for name, value in each.items()}
    return found


def save(config: PreTrainedConfig, path: Path, stats: Mapping[str, Any] | None = None) -> Path:
    """A checkpoint of random weights, as lerobot-train saves it."""
    torch.manual_seed(7)
    policy = get_policy_class(config.type)(config)
    if config.type == "vqbet":
        policy.vqbet.action_head.vqvae_model.discretized.fill_(True)
    policy.save_pretrained(path)
    for processor in make_pre_post_processors(config, dataset_stats=dict(stats or statistics())):
        processor.save_pretrained(path)
    return path


class Theirs:
    """LeRobot alone: one observation at each control step, as its own inference loop does."""

    def __init__(self, path: Path) -> None:
        self.config = PreTrainedConfig.from_pretrained(path)
        self.policy = get_policy_class(self.config.type).from_pretrained(str(path), config=self.config)
        self.pre, self.post = make_pre_post_processors(self.config, pretrained_path=str(path))

    def batch(self, values: Mapping[str, NDArray[Any]], prompt: str = "") -> dict[str, Any]:
        """An observation through the preprocessor."""
        copied = {key: np.array(value) for key, value in values.items()}
        return self.pre(prepare_observation_for_inference(copied, torch.device("cpu"), prompt, "tester"))

    def chunk(self, values: Mapping[str, NDArray[Any]], seed: int, prompt: str = "", **arguments: Any) -> NDArray[Any]:
        """Its chunk of actions, shape (N, A)."""
        torch.manual_seed(seed)
        return self.post(self.policy.predict_action_chunk(self.batch(values, prompt), **arguments)).numpy()[0]

    def select(self, values: Mapping[str, NDArray[Any]], seed: int, prompt: str = "") -> NDArray[Any]:
        """Its action at this control step, shape (A,)."""
        torch.manual_seed(seed)
        return self.post(self.policy.select_action(self.batch(values, prompt))).numpy()[0]


def normalised_by(mode: str, config: PreTrainedConfig) -> PreTrainedConfig:
    """The configuration with every feature normalised by one mode."""
    kinds = ("STATE", "VISUAL", "ENV", "ACTION")
    config.normalization_mapping = dict.fromkeys(kinds, NormalizationMode(mode))
    return config


_WORDS = (
    "<unk>",
    "<pad>",
    "<image>",
    "<fake_token_around_image>",
    "<global-img>",
    "<end>",
    "pick",
    "up",
    "the",
    "cube",
)


def language_model(path: Path) -> Path:
    """A vision-language model of SmolVLA's kind that knows four words; its weights are drawn with the policy's."""
    from tokenizers import Tokenizer
    from tokenizers.models import WordLevel
    from tokenizers.pre_tokenizers import Whitespace
    from transformers import (
        PreTrainedTokenizerFast,
        SmolVLMConfig,
        SmolVLMImageProcessor,
        SmolVLMProcessor,
        SmolVLMVideoProcessor,
    )

    words = Tokenizer(WordLevel({word: i for i, word in enumerate(_WORDS)}, unk_token="<unk>"))
    words.pre_tokenizer = Whitespace()
    special = ("image_token", "fake_image_token", "global_image_token", "end_of_utterance_token")
    tokenizer = PreTrainedTokenizerFast(
        tokenizer_object=words,
        unk_token="<unk>",
        pad_token="<pad>",
        extra_special_tokens=dict(zip(special, _WORDS[2:6], strict=True)),
    )
    SmolVLMProcessor(
        image_processor=SmolVLMImageProcessor(),
        tokenizer=tokenizer,
        video_processor=SmolVLMVideoProcessor(),
        image_seq_len=4,
    ).save_pretrained(path)
    text = {
        "model_type": "llama",
        "hidden_size": 32,
        "intermediate_size": 32,
        "num_hidden_layers": 2,
        "head_dim": 8,
        "num_attention_heads": 4,
        "num_key_value_heads": 2,
        "vocab_size": len(_WORDS),
        "pad_token_id": 1,
    }
    vision = {
        "hidden_size": 16,
        "intermediate_size": 16,
        "num_hidden_layers": 1,
        "num_attention_heads": 2,
        "image_size": 32,
        "patch_size": 8,
    }
    SmolVLMConfig(
        text_config=text, vision_config=vision, scale_factor=2, image_token_id=2, pad_token_id=1
    ).save_pretrained(path)
    return path


def smolvla(language: Path, **changes: Any) -> SmolVLAConfig:
    """One camera and a prompt."""
    small = {"num_vlm_layers": 2, "num_steps": 3, "resize_imgs_with_padding": (32, 32), "max_state_dim": 8}
    given = features(STATE, TOP) | small | {"chunk_size": CHUNK, "n_action_steps": CHUNK, "max_action_dim": 8} | changes
    return SmolVLAConfig(vlm_model_name=str(language), **given)

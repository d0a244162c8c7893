"""Weights and extras that a policy of LeRobot needs, read from source text and metadata."""

from __future__ import annotations

from pathlib import Path

import pytest
from ibrobot_lerobot.pretrained import on_this_machine, pretrained

CONFIG = """
@dataclass
class ActConfig:
    vision_backbone: str = "resnet18"
    pretrained_backbone_weights: str | None = "ResNet18_Weights.IMAGENET1K_V1"
    vlm: str = "HuggingFaceTB/SmolVLM2"
    other: str = "mean/"
    steps: int = 3
"""
PROCESSOR = """
steps = [TokenizerProcessorStep(tokenizer_name="google/paligemma-3b-pt-224", padding="max_length")]
"""


def test_weights_are_read_from_the_source_of_a_policy(tmp_path: Path) -> None:
    (tmp_path / "configuration_act.py").write_text(CONFIG)
    (tmp_path / "processor_act.py").write_text(PROCESSOR)
    assert pretrained(tmp_path) == {
        "pretrained_backbone_weights": "ResNet18_Weights.IMAGENET1K_V1",
        "vlm": "HuggingFaceTB/SmolVLM2",
        "tokenizer_name": "google/paligemma-3b-pt-224",
    }


def test_weights_in_a_cache_are_on_this_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path / "hub"))
    backbone, model = "ResNet18_Weights.IMAGENET1K_V1", "HuggingFaceTB/SmolVLM2"
    assert not on_this_machine(backbone)
    assert not on_this_machine(model)
    (tmp_path / "torch/hub/checkpoints").mkdir(parents=True)
    (tmp_path / "torch/hub/checkpoints/resnet18-f37072fd.pth").write_text("")
    (tmp_path / "hub/models--HuggingFaceTB--SmolVLM2/snapshots/0123/blob").mkdir(parents=True)
    assert on_this_machine(backbone)
    assert on_this_machine(model)
    assert on_this_machine("null")
    assert on_this_machine(str(tmp_path))

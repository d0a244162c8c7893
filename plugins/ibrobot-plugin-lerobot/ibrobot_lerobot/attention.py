"""What an ACT attends to, taken from its last decoder layer, which computes it anyway."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from lerobot.policies.act.modeling_act import ACT
from numpy.typing import NDArray


class Attention:
    """Keeps what the last decoder layer of an ACT attended to in its newest run.

    Args:
        network: the network.
        cameras: the keys of its images, in the order in which it takes them.
    """

    def __init__(self, network: ACT, cameras: Sequence[str]) -> None:
        self._cameras = cameras
        self._weights: torch.Tensor | None = None
        self._sizes: list[tuple[int, int]] = []
        network.register_forward_pre_hook(lambda module, given: self._sizes.clear())
        network.encoder_img_feat_input_proj.register_forward_hook(self._projected)
        network.decoder.layers[-1].multihead_attn.register_forward_hook(self._attended)

    def take(self) -> list[dict[str, NDArray[np.float32]]]:
        """For each request of the newest run: image -> weights, shape (h, w), the mean over the chunk.

        All that it attends to sums up to 1, the state included.
        """
        assert self._weights is not None
        looks = self._weights.float().mean(dim=1).numpy(force=True)
        cells = sum(height * width for height, width in self._sizes)
        shown = [self._split(each[-cells:]) for each in looks]
        self._weights = None
        return shown

    def _projected(self, module: torch.nn.Module, given: object, output: torch.Tensor) -> None:
        self._sizes.append((output.shape[-2], output.shape[-1]))

    def _attended(self, module: torch.nn.Module, given: object, output: tuple[torch.Tensor, torch.Tensor]) -> None:
        self._weights = output[1]

    def _split(self, looks: NDArray[np.float32]) -> dict[str, NDArray[np.float32]]:
        """The weights of each image, which come one after the other."""
        shown, at = {}, 0
        for camera, (height, width) in zip(self._cameras, self._sizes, strict=True):
            shown[camera] = looks[at : at + height * width].reshape(height, width).copy()
            at += height * width
        return shown

"""The networks of LeRobot's policies as graphs with fixed inputs and one output, for torch's ONNX exporter."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, override

import attrs
import torch
from torch import nn

from ibrobot_core.api import PolicyError
from ibrobot_lerobot.steps import Steps

_IMAGES = "observation.images"


@attrs.frozen(eq=False)
class Graph:
    """A network to export."""

    file: str
    module: nn.Module
    inputs: Mapping[str, torch.Tensor]
    """Name -> an example, in the order of the module's arguments; the first dimension counts requests."""
    output: str


@attrs.frozen(eq=False)
class Exportable:
    """A policy as graphs, and how to use them; the names are those of the manifest of `ibrobot-plugin-onnx`."""

    graphs: Sequence[Graph]
    first: int = 0
    noise: Mapping[str, Any] | None = None
    clip: float | None = None
    denoising_steps: Sequence[Sequence[float]] = ()


class _Observed(nn.Module):  # type: ignore[misc]  # torch is not installed with mypy
    """Base of the graphs that see observations: converts them to the inputs of LeRobot's network.

    Args:
        policy: LeRobot's policy.
        steps: the preprocessor, for torch.
        names: names of the observations in the contract, in the order of the arguments of `forward`.
    """

    def __init__(self, policy: Any, steps: Steps, names: Sequence[str]) -> None:
        super().__init__()
        self.policy, self._steps, self._names = policy, steps, names

    def batch(self, values: Sequence[torch.Tensor]) -> dict[str, torch.Tensor]:
        """The normalised inputs; images (B, ..., C, H, W)."""
        given = dict(zip(self._names, values, strict=True))
        for name, value in given.items():
            if value.dtype == torch.uint8:
                given[name] = value.movedim(-1, -3).to(torch.float32) / 255
        batch: dict[str, torch.Tensor] = self._steps(given)
        return batch

    def with_images(self, values: Sequence[torch.Tensor]) -> dict[str, torch.Tensor]:
        """The same with all cameras stacked, (B, T, cameras, C, H, W)."""
        batch = self.batch(values)
        cameras = [batch[key] for key in self.policy.config.image_features]
        return batch | ({_IMAGES: torch.stack(cameras, dim=-4)} if cameras else {})


class _Act(_Observed):
    @override
    def forward(self, *values: torch.Tensor) -> torch.Tensor:
        batch: dict[str, Any] = dict(self.batch(values))
        if self.policy.config.image_features:
            batch[_IMAGES] = [batch[key] for key in self.policy.config.image_features]
        actions: torch.Tensor = self.policy.model(batch)[0]
        return actions


class _VqBet(_Observed):
    """Its codes are drawn with the last argument, uniform numbers, in place of torch's generator."""

    @override
    def forward(self, *values: torch.Tensor) -> torch.Tensor:
        *observations, noise = values
        with _drawing_with(noise):
            actions: torch.Tensor = self.policy.vqbet(self.with_images(observations), rollout=True)
        return actions


class _DiffusionCondition(_Observed):
    @override
    def forward(self, *values: torch.Tensor) -> torch.Tensor:
        condition: torch.Tensor = self.policy.diffusion._prepare_global_conditioning(self.with_images(values))
        return condition


class _DenoisingStep(nn.Module):  # type: ignore[misc]  # as above
    def __init__(self, policy: Any) -> None:
        super().__init__()
        self.unet = policy.diffusion.unet

    @override
    def forward(self, *values: torch.Tensor) -> torch.Tensor:
        sample, time, condition = values
        output: torch.Tensor = self.unet(sample, time, global_cond=condition)
        return output


def act(policy: Any, steps: Steps, inputs: Mapping[str, torch.Tensor]) -> Exportable:
    """ACT: one graph."""
    return Exportable([Graph("policy.onnx", _Act(policy, steps, list(inputs)), inputs, "action")])


def vqbet(policy: Any, steps: Steps, inputs: Mapping[str, torch.Tensor]) -> Exportable:
    """VQ-BeT: one graph, with the random numbers that select its codes as an input."""
    config = policy.config
    if config.sequentially_select:
        raise PolicyError("VQ-BeT with sequentially_select cannot be exported: it draws codes one after the other")
    tokens = config.n_action_pred_token + config.n_obs_steps - 1
    shape = [tokens, policy.vqbet.action_head.vqvae_model.vqvae_num_layers]
    some = next(iter(inputs.values()))
    drawn = {**inputs, "noise": torch.rand(some.shape[0], *shape)}
    graph = Graph("policy.onnx", _VqBet(policy, steps, list(inputs)), drawn, "action")
    return Exportable([graph], noise={"distribution": "uniform", "shape": shape})


def diffusion(policy: Any, steps: Steps, inputs: Mapping[str, torch.Tensor]) -> Exportable:
    """Diffusion: a graph that encodes the observations, and one of a denoising step, which is called in a loop."""
    config = policy.config
    encode = Graph("condition.onnx", _DiffusionCondition(policy, steps, list(inputs)), inputs, "condition")
    with torch.no_grad():
        condition = encode.module(*inputs.values())
    shape = [config.horizon, config.action_feature.shape[0]]
    sample = torch.randn(len(condition), *shape)
    time = torch.full((len(condition),), 1, dtype=torch.long)
    denoise = Graph(
        "denoise.onnx", _DenoisingStep(policy), {"sample": sample, "time": time, "condition": condition}, "output"
    )
    scheduler = policy.diffusion.noise_scheduler
    scheduler.set_timesteps(policy.diffusion.num_inference_steps)
    clip = float(scheduler.config.clip_sample_range) if scheduler.config.clip_sample else None
    table = [_coefficients(scheduler, int(t)) for t in scheduler.timesteps]
    _check_coefficients(scheduler, table, clip)
    return Exportable(
        [encode, denoise], config.n_obs_steps - 1, {"distribution": "normal", "shape": shape}, clip, table
    )


GRAPHS: Mapping[str, Callable[[Any, Steps, Mapping[str, torch.Tensor]], Exportable]] = {
    "act": act,
    "diffusion": diffusion,
    "vqbet": vqbet,
}
"""LeRobot's name of a policy's type -> its graphs."""


@contextlib.contextmanager
def _drawing_with(noise: torch.Tensor) -> Iterator[None]:
    """A context in which `torch.multinomial` selects by `noise`, uniform from 0 to 1, one number for each row."""

    def select(probabilities: torch.Tensor, num_samples: int) -> torch.Tensor:
        below = probabilities.cumsum(-1) / probabilities.sum(-1, keepdim=True) <= noise.reshape(-1, 1)
        return below.sum(-1, keepdim=True).clamp_max(probabilities.shape[-1] - 1)

    own = torch.multinomial
    torch.multinomial = select
    try:
        yield
    finally:
        torch.multinomial = own


def _coefficients(scheduler: Any, t: int) -> list[float]:
    """A step of the scheduler, as `DenoisingStep` of the manifest has it; all are linear except for the clipping."""
    config, kind = scheduler.config, type(scheduler).__name__
    before = t - config.num_train_timesteps // scheduler.num_inference_steps
    last = scheduler.final_alpha_cumprod if kind == "DDIMScheduler" else scheduler.one
    a, b = float(scheduler.alphas_cumprod[t]), float(scheduler.alphas_cumprod[before] if before >= 0 else last)
    estimate_x, estimate_y = {
        "epsilon": (a**-0.5, -(((1 - a) / a) ** 0.5)),
        "sample": (0.0, 1.0),
        "v_prediction": (a**0.5, -((1 - a) ** 0.5)),
    }[config.prediction_type]
    if kind == "DDIMScheduler":
        # The noise in x, by the estimate before it is clipped.
        noise_x, noise_y = (1 - a**0.5 * estimate_x) / (1 - a) ** 0.5, -(a**0.5) * estimate_y / (1 - a) ** 0.5
        left = (1 - b) ** 0.5
        return [t, estimate_x, estimate_y, b**0.5, left * noise_x, left * noise_y, 0.0]
    present = a / b
    variance = max((1 - b) / (1 - a) * (1 - present), 1e-20) if t > 0 else 0.0
    return [
        t, estimate_x, estimate_y, b**0.5 * (1 - present) / (1 - a), present**0.5 * (1 - b) / (1 - a), 0.0,
        variance**0.5,
    ]  # fmt: skip


def _check_coefficients(scheduler: Any, table: Sequence[Sequence[float]], clip: float | None) -> None:
    """Check each step against the scheduler itself, which may have settings that the coefficients do not cover.

    Raises:
        PolicyError: if they differ.
    """
    x, y = torch.randn(2, 1, 16, 4, generator=torch.Generator().manual_seed(0))
    for t, estimate_x, estimate_y, next_e, next_x, next_y, next_z in table:
        z = torch.randn(x.shape, generator=torch.Generator().manual_seed(1))
        estimate = estimate_x * x + estimate_y * y
        estimate = estimate if clip is None else estimate.clamp(-clip, clip)
        ours = next_e * estimate + next_x * x + next_y * y + next_z * z
        theirs = scheduler.step(y, int(t), x, generator=torch.Generator().manual_seed(1)).prev_sample
        if not torch.allclose(ours, theirs, rtol=1e-3, atol=1e-3):
            raise PolicyError(
                f"the noise scheduler {type(scheduler).__name__} has settings that the export does not cover; "
                f"step {int(t)} differs by {float((ours - theirs).abs().max()):.2g}"
            )

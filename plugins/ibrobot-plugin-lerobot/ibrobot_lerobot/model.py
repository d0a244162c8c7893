"""The network of a checkpoint, in torch: loaded with LeRobot, stateless between chunks."""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from contextlib import nullcontext
from typing import Any

import numpy as np
import torch
from ibrobot_provenance.recorded_names import ATTENTION
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.factory import get_policy_class
from lerobot.policies.rtc.configuration_rtc import RTCConfig
from numpy.typing import NDArray

from ibrobot_core.api import Policy, PolicyError, Tensors
from ibrobot_lerobot.attention import Attention
from ibrobot_lerobot.checkpoint import ACTION, Checkpoint
from ibrobot_lerobot.draws import Draw, Draws, NotByRequest
from ibrobot_lerobot.options import LeRobotPolicyOptions
from ibrobot_lerobot.policy_types import import_others
from ibrobot_lerobot.quiet import cause
from ibrobot_lerobot.steps import Steps

_IMAGES, _IMAGE = "observation.images", "observation.image"
_OWN = ("seed", "task", "prefix", "delay_steps")
"""Tensors that are not inputs of the network."""


class PolicyModel:
    """A loaded network.

    Args:
        checkpoint: the checkpoint, with weights.
        options: device, precision, threads.
        steps: preprocessor steps to apply to `pictures`.
        pictures: names of unprocessed camera images, (H, W, C) or (T, H, W, C), uint8.
        log: logger for the device in use.

    Raises:
        PolicyError: if the device is not available, or LeRobot cannot load the checkpoint.
    """

    def __init__(
        self,
        checkpoint: Checkpoint,
        options: LeRobotPolicyOptions,
        steps: Steps,
        pictures: Sequence[str],
        log: logging.Logger,
    ) -> None:
        self._checkpoint = checkpoint
        self._device = torch.device(_device(options.device))
        if self._device.type == "cuda":
            _make_repeatable(options.dtype)
        self.steps = steps.of(lambda array: torch.from_numpy(np.array(array)).to(self._device))
        """The preprocessor's steps, on the network's device."""
        self._pictures = pictures
        threads = options.threads or max(1, _cores() - 1)
        torch.set_num_threads(threads)
        self.network = self._load(options)
        """LeRobot's policy."""
        self._autocast = getattr(torch, options.dtype) if options.dtype in ("bfloat16", "float16") else None
        self._chunk = torch.compile(self.network.predict_action_chunk) if options.compile else None
        keys = {name: key for key, name in checkpoint.names.items()}
        cameras = [keys[name] for name in self.network.config.image_features] if checkpoint.type == "act" else []
        self._attention = Attention(self.network.model, cameras) if cameras and not options.compile else None
        self._draws: Sequence[Draw] = ()
        """The random draws of a single request."""
        self._one_by_one = False
        """Whether random draws cannot be assigned to requests."""
        self._log = log
        self.place = place = f"{self._device}" if options.dtype == "auto" else f"{self._device} in {options.dtype}"
        """Device, the precision if it was chosen, and what else a CPU's rounding depends on."""
        if self._device.type == "cpu":
            self.place += f", {torch.backends.cpu.get_cpu_capability()}, threads {threads}"
        log.info("%s on %s, %d threads", checkpoint.type, place, threads)

    def warm_up(self, tensors: Tensors) -> NDArray[np.float32]:
        """Run the network once and check that it returns an action chunk, shape (1, N, A), which is returned.

        Raises:
            PolicyError: if it fails, does not return a chunk, e.g. because the policy plans step by step, or returns
                values that are not finite.
        """
        try:
            action = self.predict([tensors])[0][ACTION]
        except Exception as error:
            raise PolicyError(
                f"{self._checkpoint.path}: its first run failed: {type(error).__name__}: {error}"
            ) from error
        size, length = self._checkpoint.action_size, self._checkpoint.chunk_size
        if action.ndim != 3 or action.shape[0] != 1 or action.shape[2] != size or not 1 <= action.shape[1] <= length:
            raise PolicyError(
                f"{self._checkpoint.path}: {self._checkpoint.type} returns actions of shape {action.shape}; "
                f"a chunk has (1, up to {length}, {size})"
            )
        hint = f" ({self._autocast}; bfloat16 and float32 have a larger range)" if self._autocast is not None else ""
        Policy.check_finite(f"{self._checkpoint.path}: infer of its first run{hint}", {ACTION: action})
        return action

    def predict(self, batch: Sequence[Tensors]) -> list[dict[str, NDArray[np.float32]]]:
        """Compute the outputs of requests whose tensors have equal names and shapes.

        Each has a chunk, shape (1, N, A), and for an ACT with cameras what it attends to in each image, shape (h, w).

        The requests form one batch, in which each draws noise with its own seed. Requests with a prefix run one by
        one, because their delays may differ.
        """
        if len(batch) > 1 and (self._one_by_one or "prefix" in batch[0]):
            return [self.predict([tensors])[0] for tensors in batch]
        inputs = self.inputs(batch)
        devices = [self._device] if self._device.type == "cuda" else []
        autocast = torch.autocast(self._device.type, self._autocast) if self._autocast is not None else nullcontext()
        with torch.random.fork_rng(devices), torch.no_grad(), autocast:
            draws = Draws([int(tensors["seed"][0]) for tensors in batch], self._device, self._draws)
            try:
                with draws if self._chunk is None else nullcontext():  # a compiled network cannot be intercepted
                    actions = self._run(inputs, batch)
                escaped = draws.escaped and len(batch) > 1
            except NotByRequest:
                escaped = True
        if escaped:
            self._one_by_one = True
            self._log.info(
                "%s draws random numbers that cannot be assigned to requests, so requests run one by one",
                self._checkpoint.type,
            )
            return self.predict(batch)
        if len(batch) == 1 and "prefix" not in batch[0]:
            self._draws = draws.made
        result = actions.float().numpy(force=True)
        outputs = [{ACTION: np.array(result[i : i + 1])} for i in range(len(batch))]
        if self._attention is not None:
            for output, looks in zip(outputs, self._attention.take(), strict=True):
                output |= {f"{ATTENTION}{image}": weights for image, weights in looks.items()}
        return outputs

    def inputs(self, batch: Sequence[Tensors]) -> dict[str, Any]:
        """The network's inputs: the requests' tensors on its device, with normalised images."""
        inputs: dict[str, Any] = {
            name: torch.from_numpy(np.concatenate([tensors[name] for tensors in batch])).to(self._device)
            for name in batch[0]
            if name not in _OWN and name not in self._pictures
        }
        return inputs | self.steps(
            {name: self._pixels([tensors[name] for tensors in batch]) for name in self._pictures}
        )

    def _pixels(self, pictures: Sequence[NDArray[Any]]) -> torch.Tensor:
        """Images in LeRobot's layout, (B, ..., C, H, W), from 0 to 1."""
        pixels = torch.from_numpy(np.stack(pictures)).to(self._device)
        return pixels.movedim(-1, -3).contiguous().to(torch.float32) / 255

    def _run(self, inputs: dict[str, Any], batch: Sequence[Tensors]) -> torch.Tensor:
        policy, request = self.network, batch[0]
        policy.reset()
        if "task" in request:
            inputs["task"] = [tensors["task"].tobytes().decode() for tensors in batch]
        self._fill_queues(inputs)
        arguments: dict[str, Any] = {}
        if "prefix" in request:
            prefix = torch.from_numpy(np.array(request["prefix"])).to(self._device)
            arguments = {"inference_delay": int(request["delay_steps"][0]), "prev_chunk_left_over": prefix}
        actions: torch.Tensor = (self._chunk or policy.predict_action_chunk)(inputs, **arguments)
        return actions

    def _fill_queues(self, inputs: dict[str, Any]) -> None:
        """Fill LeRobot's queues of past observations with the request's, oldest first."""
        queues = {key: queue for key, queue in getattr(self.network, "_queues", {}).items() if key != ACTION}
        cameras = [inputs[key] for key in self.network.config.image_features if key in inputs]
        if not queues:
            return
        if self._checkpoint.n_obs_steps == 1:
            cameras = [camera.unsqueeze(1) for camera in cameras]
        for key, queue in queues.items():
            if key == _IMAGES:
                seen = torch.stack(cameras, dim=-4)
            elif key == _IMAGE:
                seen = cameras[0]
            else:
                seen = inputs[key] if self._checkpoint.n_obs_steps > 1 else inputs[key].unsqueeze(1)
            queue.extend(seen.unbind(1))
            inputs[key] = seen[:, -1]

    def _load(self, options: LeRobotPolicyOptions) -> Any:
        path = self._checkpoint.path
        import_others(path, self._checkpoint.type)
        try:
            config = PreTrainedConfig.from_pretrained(path)
            config.pretrained_path = path  # the file may have another path
            config.device = str(self._device)
            if hasattr(config, "pretrained_backbone_weights"):
                config.pretrained_backbone_weights = None  # the checkpoint contains them; avoid a download
            chunked = hasattr(config, "rtc_config")
            if chunked:
                config.rtc_config = config.rtc_config or RTCConfig()
            policy = get_policy_class(config.type).from_pretrained(str(path), config=config, strict=True)
            if chunked and hasattr(policy, "init_rtc_processor"):
                policy.init_rtc_processor()
        except Exception as error:
            raise PolicyError(f"{path}: LeRobot cannot load it: {cause(error)}") from error
        for name, tensor in policy.named_parameters():
            if not torch.isfinite(tensor).all():
                raise PolicyError(f"{path}: the weights {name} have values that are not finite, such as NaN")
        policy.to(self._device, torch.float32 if options.dtype == "float32" else None)
        return policy.eval()


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _make_repeatable(dtype: str) -> None:
    """Let cuDNN choose its algorithms without trials, so that equal requests have equal answers.

    `float32` also rules out TF32, in which it computes convolutions otherwise: with 10 bits of mantissa instead of 23.
    """
    torch.backends.cudnn.benchmark = False
    torch.backends.cudnn.deterministic = True
    if dtype == "float32":
        torch.backends.cudnn.allow_tf32 = False


def _device(requested: str) -> str:
    available = {"cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available(), "cpu": True}
    names = [name for name, is_available in available.items() if is_available]
    if requested == "auto":
        return names[0]
    if requested not in names:
        raise PolicyError(f"torch finds no device {requested!r} on this machine; available: {', '.join(names)}")
    return requested

"""Eight robots' requests in one run of a policy of LeRobot's, against eight single runs.

    python benchmarks/policy_batch.py [--requests 8] [--rounds 3] [--device cpu] [--threads 1]

Needs LeRobot. The networks have random weights and cameras of 96x96. VQ-BeT has LeRobot's default size; Diffusion has a
quarter of its default widths, and five steps of denoising. Prints medians [ms] of rounds taken in turn (on the CPU, of
processor time), and how far the actions of a batch are from those of single runs. Exits with 1 when one run is not
faster, or actions differ by 1e-4 or more.
"""

from __future__ import annotations

import argparse
import json
import logging
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from ibrobot_lerobot.options import LeRobotPolicyOptions
from ibrobot_lerobot.policy import LeRobotPolicy
from ibrobot_testing import host_context
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.policies.vqbet.configuration_vqbet import VQBeTConfig
from progress import in_rounds

from ibrobot_core.interfaces import Frame, Tensors

LIMIT = 1e-4
STATE, TOP, WRIST = "observation.state", "observation.images.top", "observation.images.wrist"


def configs() -> dict[str, Any]:
    """Of the policies; VQ-BeT sees one camera."""
    state, camera = PolicyFeature(FeatureType.STATE, (6,)), PolicyFeature(FeatureType.VISUAL, (3, 96, 96))
    common = {
        "input_features": {STATE: state, TOP: camera, WRIST: camera},
        "output_features": {"action": PolicyFeature(FeatureType.ACTION, (6,))},
        "device": "cpu",
        "pretrained_backbone_weights": None,
    }
    one = common | {"input_features": {STATE: state, TOP: camera}}
    return {
        "diffusion": DiffusionConfig(down_dims=(128, 256, 512), num_inference_steps=5, **common),
        "vqbet": VQBeTConfig(**one),
    }


def saved(config: Any, path: Path) -> Path:
    """A checkpoint of random weights."""
    policy = get_policy_class(config.type)(config)
    if config.type == "vqbet":
        policy.vqbet.action_head.vqvae_model.discretized.fill_(True)
    policy.save_pretrained(path)
    shapes = {STATE: (6,), TOP: (3, 1, 1), WRIST: (3, 1, 1), "action": (6,)}
    statistics = {
        key: {"min": -np.ones(n), "max": np.ones(n), "mean": np.zeros(n), "std": np.ones(n)}
        for key, n in shapes.items()
    }
    for processor in make_pre_post_processors(config, dataset_stats=statistics):
        processor.save_pretrained(path)
    return path


def requests(policy: LeRobotPolicy, count: int) -> list[Tensors]:
    """Of as many robots, each with its own observation and seed."""
    rng = np.random.default_rng(1)
    found = []
    for number in range(count):
        values = {
            key: rng.integers(0, 256, shape, np.uint8) if len(shape) == 3 else rng.uniform(-1, 1, shape)
            for key, shape in policy.spec.observations.items()
        }
        floats = {key: value if value.dtype == np.uint8 else value.astype(np.float32) for key, value in values.items()}
        found.append(policy.preprocess(Frame(number, floats)))
    return found


def timed(run: Callable[[], Any], clock: Callable[[], float]) -> float:
    """How long it takes by a clock [ms]."""
    begun_s = clock()
    run()
    return (clock() - begun_s) * 1e3


def measure(policy: LeRobotPolicy, count: int, rounds: int, clock: Callable[[], float]) -> dict[str, Any]:
    """One run of `count` requests, and `count` runs of one."""
    batch = requests(policy, count)
    together = [policy.postprocess(outputs) for outputs in policy.infer_batch(batch)]
    alone = [policy.postprocess(policy.infer(tensors)) for tensors in batch]
    single_ms, one_run_ms = [], []
    for _ in in_rounds(rounds):
        single_ms.append(timed(lambda: [policy.infer(tensors) for tensors in batch], clock))
        one_run_ms.append(timed(lambda: policy.infer_batch(batch), clock))
    single, one_run = np.median(single_ms), np.median(one_run_ms)
    return {
        "requests": count,
        "single_runs_ms": round(float(single), 1),
        "one_run_ms": round(float(one_run), 1),
        "times_as_fast": round(float(single / one_run), 2),
        "largest_difference": float(np.abs(np.stack(together) - np.stack(alone)).max()),
    }


def main() -> int:
    """All policies; 1 when a limit is missed."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--requests", type=int, default=8)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, default=1)
    given = parser.parse_args()
    logging.disable(logging.CRITICAL)
    # The CPU may have other work; a GPU has not, and its time is not this process's.
    clock = time.process_time if given.device == "cpu" else time.perf_counter
    missed = False
    for name, config in configs().items():
        torch.manual_seed(7)
        with tempfile.TemporaryDirectory() as folder:
            path = saved(config, Path(folder) / name)
            policy = LeRobotPolicy(
                LeRobotPolicyOptions(path, device=given.device, threads=given.threads), host_context()
            )
            policy.load()
            result = measure(policy, given.requests, given.rounds, clock)
        print(json.dumps({"policy": name, "device": given.device, "threads": given.threads, **result}), flush=True)
        missed |= result["times_as_fast"] <= 1.0 or result["largest_difference"] >= LIMIT
    return int(missed)


if __name__ == "__main__":
    sys.exit(main())

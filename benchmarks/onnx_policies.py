"""Exported policies on ONNX Runtime, beside LeRobot's checkpoints on torch.

    python benchmarks/onnx_policies.py [--policy act] [--checkpoint FOLDER] [--observations 100] [--rounds 20]

Needs LeRobot, onnx, onnxscript and ONNX Runtime. Without --checkpoint, the policy has random weights and one camera of
320x240. Prints the largest difference of actions from torch on random observations (for a policy that draws noise, of
the graphs' outputs), milliseconds of processor time per chunk of both, taken in turn, and the memory of a process that
runs each [MiB]. Exits with 1 if they differ by 1e-4 or more, or ONNX Runtime is not faster.
"""

from __future__ import annotations

import argparse
import json
import logging
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from ibrobot_lerobot.export import export_onnx
from ibrobot_lerobot.options import LeRobotPolicyOptions
from ibrobot_lerobot.policy import LeRobotPolicy
from ibrobot_onnx.options import OnnxPolicyOptions
from ibrobot_onnx.policy import OnnxPolicy
from ibrobot_testing import host_context
from progress import in_rounds

from ibrobot_core.interfaces import Frame, Policy

LIMIT = 1e-4
STATE, TOP = "observation.state", "observation.images.top"
MEMORY = """
import sys
from pathlib import Path
from ibrobot_testing import host_context
path, threads = Path(sys.argv[2]), int(sys.argv[3])
if sys.argv[1] == "onnx":
    from ibrobot_onnx.options import OnnxPolicyOptions
    from ibrobot_onnx.policy import OnnxPolicy
    policy = OnnxPolicy(OnnxPolicyOptions(path, threads=threads), host_context())
else:
    from ibrobot_lerobot.options import LeRobotPolicyOptions
    from ibrobot_lerobot.policy import LeRobotPolicy
    policy = LeRobotPolicy(LeRobotPolicyOptions(path, device="cpu", threads=threads), host_context())
policy.load()
status = Path("/proc/self/status").read_text()  # ru_maxrss is the parent's, if that was larger
print(int(next(line for line in status.splitlines() if line.startswith("VmHWM")).split()[1]) // 1024)
"""


def random_policy(kind: str, path: Path) -> Path:
    """A checkpoint with random weights, one camera of 320x240 and six joints.

    Of LeRobot's default size, but Diffusion has a quarter of its widths, and ten steps of DDIM.
    """
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.configs.types import FeatureType, PolicyFeature
    from lerobot.policies.factory import get_policy_class, make_pre_post_processors

    sizes: dict[str, dict[str, Any]] = {
        "act": {"chunk_size": 50, "n_action_steps": 50},
        "diffusion": {"down_dims": (128, 256, 512), "noise_scheduler_type": "DDIM", "num_inference_steps": 10},
        "vqbet": {},
    }
    config = PreTrainedConfig.get_choice_class(kind)(
        input_features={
            STATE: PolicyFeature(FeatureType.STATE, (6,)),
            TOP: PolicyFeature(FeatureType.VISUAL, (3, 240, 320)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (6,))},
        device="cpu",
        pretrained_backbone_weights=None,
        **sizes[kind],
    )
    policy = get_policy_class(kind)(config)
    if kind == "vqbet":  # as after its first phase of training
        policy.vqbet.action_head.vqvae_model.discretized.fill_(True)
    policy.save_pretrained(path)
    shapes = {STATE: (6,), TOP: (3, 1, 1), "action": (6,)}
    statistics = {
        key: {
            "mean": np.zeros(n, np.float32),
            "std": np.ones(n, np.float32),
            "min": -np.ones(n, np.float32),
            "max": np.ones(n, np.float32),
        }
        for key, n in shapes.items()
    }
    for processor in make_pre_post_processors(config, dataset_stats=statistics):
        processor.save_pretrained(path)
    return path


def frames(policy: Policy, count: int) -> list[Frame]:
    """Random observations."""
    rng = np.random.default_rng(1)
    return [
        Frame(
            number,
            {
                key: rng.integers(0, 256, shape, np.uint8) if len(shape) == 3 else rng.random(shape, np.float32)
                for key, shape in policy.spec.observations.items()
            },
        )
        for number in range(count)
    ]


def chunk(policy: Policy, frame: Frame) -> Any:
    """The actions for a frame."""
    return policy.postprocess(policy.infer(policy.preprocess(frame)))


def memory_mib(kind: str, path: Path, threads: int) -> int:
    """The largest memory of a process that loads a policy and runs it once [MiB]."""
    found = subprocess.run(
        [sys.executable, "-c", MEMORY, kind, str(path), str(threads)], capture_output=True, text=True, check=True
    )
    return int(found.stdout)


def main() -> int:
    """One policy; 1 if a limit is missed."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--checkpoint", type=Path)
    parser.add_argument("--policy", choices=("act", "diffusion", "vqbet"), default="act")
    parser.add_argument("--observations", type=int, default=100)
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--threads", type=int, default=1)
    given = parser.parse_args()
    logging.disable(logging.CRITICAL)
    with tempfile.TemporaryDirectory() as folder:
        checkpoint = given.checkpoint or random_policy(given.policy, Path(folder) / given.policy)
        exported = export_onnx(checkpoint, Path(folder) / "onnx")
        policies: dict[str, Policy] = {
            "torch": LeRobotPolicy(
                LeRobotPolicyOptions(checkpoint, device="cpu", threads=given.threads), host_context()
            ),
            "onnx": OnnxPolicy(OnnxPolicyOptions(exported.folder, threads=given.threads), host_context()),
        }
        for policy in policies.values():
            policy.load()
        seen = frames(policies["onnx"], given.observations)
        difference = exported.largest_difference  # of the graphs
        if json.loads((exported.folder / "onnx_policy.json").read_text())["noise"] is None:
            difference = max(
                float(np.abs(chunk(policies["onnx"], frame) - chunk(policies["torch"], frame)).max()) for frame in seen
            )
        times_ms: dict[str, list[float]] = {name: [] for name in policies}
        for number in in_rounds(given.rounds):
            for name, policy in policies.items():
                begun_s = time.process_time()  # the machine may have other work
                chunk(policy, seen[number % len(seen)])
                times_ms[name].append((time.process_time() - begun_s) * 1e3)
        medians = {name: float(np.median(values)) for name, values in times_ms.items()}
        result = {
            "policy": exported.type,
            "threads": given.threads,
            "observations": given.observations,
            "largest_difference": difference,
            **{f"{name}_ms": round(value, 1) for name, value in medians.items()},
            **{
                f"{name}_mib": memory_mib(name, place, given.threads)
                for name, place in (("torch", checkpoint), ("onnx", exported.folder))
            },
            "export_s": round(exported.seconds, 1),
        }
    print(json.dumps(result))
    return int(difference >= LIMIT or medians["onnx"] >= medians["torch"])


if __name__ == "__main__":
    sys.exit(main())

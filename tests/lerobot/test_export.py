"""Exported policies act as LeRobot does, without torch."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import pytest
import torch
from ibrobot_lerobot.export import export_onnx
from ibrobot_lerobot.options import LeRobotPolicyOptions
from ibrobot_lerobot.policy import LeRobotPolicy
from ibrobot_onnx.options import OnnxPolicyOptions
from ibrobot_onnx.policy import OnnxPolicy
from ibrobot_testing.contexts import START_NS, host_context
from numpy.typing import NDArray

from ibrobot_core.errors import PolicyError
from ibrobot_core.interfaces import Frame

sys.path.insert(0, str(Path(__file__).parent))
from checkpoints import CONFIGS, act, diffusion, save, vqbet

pytestmark = pytest.mark.lerobot

TOLERANCE = 2e-5
OBSERVATIONS = 25


LONG = [pytest.param(name, marks=pytest.mark.long) for name in ("act", "diffusion")]


@pytest.fixture(scope="module", params=["vqbet", *LONG])
def exported(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The checkpoint of a policy, and what it was exported to."""
    root = tmp_path_factory.mktemp(request.param)
    checkpoint, folder = save(CONFIGS[request.param](), root / "checkpoint"), root / "onnx"
    assert export_onnx(checkpoint, folder).largest_difference < TOLERANCE
    return checkpoint, folder


def onnx_policy(path: Path) -> OnnxPolicy:
    policy = OnnxPolicy(OnnxPolicyOptions(path, threads=1), host_context())
    policy.load()
    policy.reset(3)
    return policy


def torch_policy(path: Path) -> LeRobotPolicy:
    policy = LeRobotPolicy(LeRobotPolicyOptions(path, threads=1, device="cpu"), host_context())
    policy.load()
    policy.reset(3)
    return policy


def frames(policy: OnnxPolicy, count: int) -> list[Frame]:
    rng = np.random.default_rng(5)
    plain = [
        Frame(
            START_NS + i * 33_333_333,
            {
                key: rng.integers(0, 256, shape, np.uint8) if len(shape) == 3 else rng.random(shape, np.float32)
                for key, shape in policy.spec.observations.items()
            },
        )
        for i in range(count)
    ]
    past = policy.spec.history
    return [attrs.evolve(frame, history=tuple(plain[max(0, i - past) : i])) for i, frame in enumerate(plain)]


class Drawn:
    """Gives torch the random numbers that the policy `onnx` draws for a frame."""

    def __init__(self, manifest: dict[str, Any]) -> None:
        self._noise = manifest["noise"]

    def begin(self, frame: Frame) -> None:
        self._random = np.random.default_rng(np.array([3, frame.stamp_ns], np.uint64))

    def normal(self, *args: Any, **kwargs: Any) -> torch.Tensor:
        return torch.from_numpy(self._random.standard_normal(self._noise["shape"], np.float32)[None])

    def code(self, probabilities: torch.Tensor, num_samples: int) -> torch.Tensor:
        uniform = torch.from_numpy(self._random.random(self._noise["shape"], np.float32)).reshape(-1, 1)
        return (probabilities.cumsum(-1) <= uniform).sum(-1, keepdim=True).clamp_max(probabilities.shape[-1] - 1)


def test_chunks_are_those_of_torch(
    exported: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch, record_property: Any
) -> None:
    checkpoint, folder = exported
    ours, theirs = onnx_policy(folder), torch_policy(checkpoint)
    drawn = Drawn(json.loads((folder / "onnx_policy.json").read_text()))
    largest, chunks = 0.0, []
    with monkeypatch.context() as patched:
        patched.setattr("torch.multinomial", drawn.code)
        patched.setattr("diffusers.schedulers.scheduling_ddpm.randn_tensor", drawn.normal)
        patched.setattr("ibrobot_lerobot.draws.Draws.__enter__", lambda draws: draws)
        patched.setattr("ibrobot_lerobot.draws.Draws.__exit__", lambda *_: None)
        patched.setattr("torch.randn", drawn.normal)
        for frame in frames(ours, OBSERVATIONS):
            found = ours.postprocess(ours.infer(ours.preprocess(frame)))
            drawn.begin(frame)
            expected: NDArray[np.float64] = theirs.postprocess(theirs.infer(theirs.preprocess(frame)))
            assert found.shape == expected.shape
            largest = max(largest, float(np.abs(found - expected).max()))
            chunks.append(found)
    record_property("largest_difference", largest)
    print(f"largest difference {largest:.2g} on {OBSERVATIONS} observations")
    assert largest < TOLERANCE
    assert np.ptp(np.stack(chunks), axis=0).max() > 1e-4, "the network answers to what it sees"


def test_spec_is_that_of_the_checkpoint(exported: tuple[Path, Path]) -> None:
    checkpoint, folder = exported
    assert onnx_policy(folder).spec == LeRobotPolicy(LeRobotPolicyOptions(checkpoint), host_context()).spec


@pytest.mark.long
def test_ddim_is_exported_too(tmp_path: Path) -> None:
    config = diffusion(noise_scheduler_type="DDIM", prediction_type="sample")
    export_onnx(save(config, tmp_path / "ddim"), tmp_path / "onnx")
    assert json.loads((tmp_path / "onnx/onnx_policy.json").read_text())["denoising_steps"][0][-1] == 0.0


def test_a_run_needs_no_torch(exported: tuple[Path, Path]) -> None:
    code = (
        "import sys; from pathlib import Path\n"
        "from ibrobot_onnx.options import OnnxPolicyOptions; from ibrobot_onnx.policy import OnnxPolicy\n"
        "from ibrobot_testing.contexts import host_context\n"
        f"policy = OnnxPolicy(OnnxPolicyOptions(Path({str(exported[1])!r})), host_context()); policy.load()\n"
        "print(sorted({'torch', 'lerobot'} & sys.modules.keys()))"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"


def test_others_are_refused_before_torch_is_loaded(tmp_path: Path) -> None:
    path = save(act(dim_model=16), tmp_path / "act")
    config = json.loads((path / "config.json").read_text())
    (path / "config.json").write_text(json.dumps(config | {"type": "smolvla"}))
    with pytest.raises(PolicyError, match=r"'smolvla' cannot be exported; act, diffusion, vqbet can"):
        export_onnx(path, tmp_path / "onnx")
    (path / "config.json").write_text(json.dumps(config))
    (tmp_path / "onnx").mkdir()
    with pytest.raises(PolicyError, match="exists already"):
        export_onnx(path, tmp_path / "onnx")


def test_codes_drawn_one_after_the_other_are_refused(tmp_path: Path) -> None:
    path = save(vqbet(sequentially_select=True), tmp_path / "vqbet")
    with pytest.raises(PolicyError, match="sequentially_select"):
        export_onnx(path, tmp_path / "onnx")
    assert not list(tmp_path.glob("onnx*")), "nothing is left behind"

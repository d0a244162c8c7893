"""Writes a checkpoint as ONNX graphs with a manifest, for the policy `onnx` of `ibrobot-plugin-onnx`."""

from __future__ import annotations

import json
import logging
import os
import shutil
import time
import warnings
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import attrs
import numpy as np

from ibrobot_core.api import PolicyError, how_to_install
from ibrobot_lerobot.checkpoint import (
    ACTION,
    POSTPROCESSOR,
    PREPROCESSOR,
    Checkpoint,
    check_weights,
    hash_weights,
    read_checkpoint,
)
from ibrobot_lerobot.options import LeRobotPolicyOptions
from ibrobot_lerobot.quiet import held_back
from ibrobot_lerobot.steps import Steps, read_steps

_LOG = logging.getLogger("ibrobot.export")
MANIFEST = "onnx_policy.json"
EXPORTED = ("act", "diffusion", "vqbet")
"""LeRobot's names of the policy types that can be exported."""
_OPSET = 20
_BATCH = 2
"""Requests in an example: with one, the exporter would fix the size of the batch."""
_CHECKS = 10
"""Batches of random inputs on which ONNX Runtime and torch are compared."""
_LARGEST_DIFFERENCE = 1e-3
"""Of outputs, which are of the order of 1."""


@attrs.frozen
class Exported:
    """The result of an export."""

    folder: Path
    type: str
    largest_difference: float
    """Largest difference of the graphs' outputs from torch's, on random inputs."""
    seconds: float
    bytes: int
    """Size of the graphs."""


def export_onnx(path: Path, out: Path) -> Exported:
    """Export the checkpoint at `path` into the new folder `out`.

    Raises:
        PolicyError: if its type or its processors cannot be exported, a package is missing, or ONNX Runtime computes
            something else than torch.
    """
    begun_s = time.monotonic()
    checkpoint = read_checkpoint(path)
    pre, post = read_steps(checkpoint, PREPROCESSOR), read_steps(checkpoint, POSTPROCESSOR)
    _check_exportable(checkpoint, pre, post)
    check_weights(checkpoint)
    if out.exists():
        raise PolicyError(f"{out}: exists already; choose a new folder with --out")
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")  # ONNX Runtime's, which is on by default
    try:
        import onnxruntime  # noqa: F401 - checked before torch is loaded, which takes long
        import onnxscript  # noqa: F401

        with held_back(_LOG):
            import torch

            from ibrobot_lerobot.model import PolicyModel
            from ibrobot_lerobot.onnx_graphs import GRAPHS
    except ImportError as error:
        raise PolicyError(
            f"an export needs LeRobot, onnxscript and ONNX Runtime ({error}); install them with: "
            f"{how_to_install('ibrobot-plugin-lerobot[export]', 'lerobot')}"
        ) from error
    options = LeRobotPolicyOptions(path, device="cpu", dtype="float32")
    with held_back(_LOG):
        model = PolicyModel(checkpoint, options, pre, (), _LOG)
    inputs = _example(checkpoint)
    policy = GRAPHS[checkpoint.type](model.network, model.steps, {k: torch.from_numpy(v) for k, v in inputs.items()})
    partial = out.with_name(f"{out.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        difference = max(_export(graph, partial / graph.file) for graph in policy.graphs)
        scale, offset = _affine(post, checkpoint.action_size)
        manifest = {
            "format": 1,
            "type": checkpoint.type,
            "observations": {key: checkpoint.inputs[name][1] for key, name in checkpoint.names.items()},
            "history": checkpoint.n_obs_steps - 1,
            "action_size": checkpoint.action_size,
            "chunk_size": checkpoint.chunk_size,
            "first": policy.first,
            "scale": scale,
            "offset": offset,
            "graphs": [graph.file for graph in policy.graphs],
            "noise": policy.noise,
            "clip": policy.clip,
            "denoising_steps": policy.denoising_steps,
            "trained_on": checkpoint.trained_on,
            "source": {
                "fingerprint": checkpoint.fingerprint(),
                "weights": hash_weights(path),
                "lerobot": version("lerobot"),
                "torch": torch.__version__,
                "largest_difference": difference,
            },
        }
        (partial / MANIFEST).write_text(json.dumps(manifest, indent=1), encoding="utf-8")
        partial.rename(out)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    size = sum(file.stat().st_size for file in out.glob("*.onnx"))
    return Exported(out, checkpoint.type, difference, time.monotonic() - begun_s, size)


def _check_exportable(checkpoint: Checkpoint, pre: Steps, post: Steps) -> None:
    if checkpoint.type not in EXPORTED:
        raise PolicyError(
            f"{checkpoint.path}: policies of type {checkpoint.type!r} cannot be exported; {', '.join(EXPORTED)} can. "
            "Others have a tokeniser, a cache or a plan between the parts of their networks: run them with type "
            "lerobot, or on a server with execution_mode: distributed"
        )
    if others := [*pre.others, *post.others]:
        raise PolicyError(
            f"{checkpoint.path}: cannot be exported, because only LeRobot runs these processor steps: "
            f"{', '.join(others)}"
        )


def _example(checkpoint: Checkpoint) -> dict[str, Any]:
    """Random observations of several requests, under their names in the contract."""
    rng = np.random.default_rng(0)
    history = (checkpoint.n_obs_steps,) if checkpoint.n_obs_steps > 1 else ()
    example: dict[str, Any] = {}
    for key, name in checkpoint.names.items():
        shape = (_BATCH, *history, *checkpoint.inputs[name][1])
        is_image = len(checkpoint.inputs[name][1]) == 3
        example[key] = rng.integers(0, 256, shape, np.uint8) if is_image else rng.normal(size=shape).astype(np.float32)
    return example


def _affine(post: Steps, size: int) -> tuple[list[float], list[float]]:
    """Scale and offset of each value of an action, which the postprocessor applies."""
    low = _unnormalised(post, np.zeros(size, np.float32))
    return (_unnormalised(post, np.ones(size, np.float32)) - low).tolist(), low.tolist()


def _unnormalised(post: Steps, action: Any) -> Any:
    exact = post.of(lambda array: np.asarray(array, np.float64))
    return np.asarray(exact({ACTION: action.astype(np.float64)})[ACTION], np.float64)


def _export(graph: Any, file: Path) -> float:
    """Write a graph; returns the largest difference of its outputs from torch's."""
    import torch

    module, batch = graph.module.eval(), torch.export.Dim("batch", min=1, max=1024)
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of torch's exporter about itself
        torch.onnx.export(
            module, tuple(graph.inputs.values()), str(file), dynamo=True, opset_version=_OPSET, verbose=False,
            input_names=list(graph.inputs), output_names=[graph.output], external_data=False,
            dynamic_shapes=(tuple({0: batch} for _ in graph.inputs),),
        )  # fmt: skip
    return _largest_difference(module, graph.inputs, file)


def _largest_difference(module: Any, inputs: Mapping[str, Any], file: Path) -> float:
    import onnxruntime
    import torch

    settings = onnxruntime.SessionOptions()
    settings.log_severity_level = 3
    session = onnxruntime.InferenceSession(str(file), settings, providers=["CPUExecutionProvider"])
    taken, largest = {each.name for each in session.get_inputs()}, 0.0
    random = torch.Generator().manual_seed(0)
    for i in range(_CHECKS):
        drawn = {name: _like(value, 1 + i % 3, random) for name, value in inputs.items()}
        with torch.no_grad():
            expected = module(*drawn.values()).numpy()
        [output] = session.run(None, {name: value.numpy() for name, value in drawn.items() if name in taken})
        if output.shape != expected.shape:
            raise PolicyError(f"{file.name}: ONNX Runtime returns shape {output.shape}, torch {expected.shape}")
        largest = max(largest, float(np.abs(output - expected).max()))
    if not largest <= _LARGEST_DIFFERENCE:
        raise PolicyError(
            f"{file.name}: ONNX Runtime's outputs differ from torch's by {largest:.2g}, must be at most "
            f"{_LARGEST_DIFFERENCE:g}"
        )
    return largest


def _like(value: Any, batch: int, random: Any) -> Any:
    """Random numbers of the kind and shape of `value`, for another number of requests."""
    import torch

    shape = (batch, *value.shape[1:])
    if value.dtype == torch.uint8:
        return torch.randint(0, 256, shape, dtype=torch.uint8, generator=random)
    if value.dtype == torch.long:
        return torch.randint(0, 50, shape, generator=random)
    return torch.rand(shape, generator=random)

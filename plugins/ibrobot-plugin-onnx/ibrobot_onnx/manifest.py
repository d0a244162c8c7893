"""The manifest of an exported policy: what its graphs take and return, read as untrusted input."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray

from ibrobot_core.api import Contract, ContractError, PolicyError
from ibrobot_onnx.options import MANIFEST

FORMAT = 1
NOISE = "noise"
"""Name of the graph's input for random numbers."""
_MAX_BYTES = 8 << 20
_MAX_SIZE = 1 << 26
"""Maximum number of elements of an observation, or of a chunk."""
_MAX_STEPS = 1000
"""Maximum number of denoising steps, and of earlier ticks."""
_FILE = re.compile(r"[A-Za-z0-9_-]+\.onnx", re.ASCII)


@attrs.frozen
class Noise:
    """Random numbers that the policy draws for each request."""

    distribution: str
    """`normal` or `uniform`, the latter from 0 to 1."""
    shape: tuple[int, ...]


@attrs.frozen
class DenoisingStep:
    """One step of denoising, as linear combinations of the sample x, the network's output y and normal noise z.

    The estimate of the clean sample is `e = clip(estimate_x * x + estimate_y * y)`; the next sample is
    `next_e * e + next_x * x + next_y * y + next_z * z`.
    """

    time: int
    estimate_x: float
    estimate_y: float
    next_e: float
    next_x: float
    next_y: float
    next_z: float


@attrs.frozen(eq=False)
class Manifest:
    """The contents of `onnx_policy.json`."""

    path: Path
    type: str
    """Name of the policy's type where it was trained, e.g. `act`."""
    observations: Mapping[str, tuple[int, ...]]
    """Key, also the name of the graph's input -> shape; images (H, W, C) are uint8, all others float32."""
    history: int
    action_size: int
    chunk_size: int
    first: int
    """Index of the first action of a chunk in the graph's output."""
    scale: NDArray[np.float64]
    offset: NDArray[np.float64]
    """Actions are `scale * output + offset`, each of shape (A,)."""
    graphs: tuple[str, ...]
    """Files: one graph, or for denoising the one that encodes observations and the one of a denoising step."""
    noise: Noise | None
    clip: float | None
    """Bound of the estimate of the clean sample; None: unbounded."""
    steps: tuple[DenoisingStep, ...]
    """Denoising steps; empty for a single graph."""
    contract: Contract | None
    """The contract that it was trained on."""
    norm_mode: str | None
    content: Mapping[str, Any]


def read_manifest(folder: Path) -> Manifest:
    """Read the manifest of the policy in `folder`.

    Raises:
        PolicyError: if there is none, or a value of it is wrong; names the file and the key.
    """
    path = folder / MANIFEST
    try:
        with path.open("rb") as file:
            text = file.read(_MAX_BYTES + 1)
        if len(text) > _MAX_BYTES:
            raise PolicyError(f"{path}: has more than {_MAX_BYTES} bytes")
        content = json.loads(text)
    except FileNotFoundError:
        raise PolicyError(
            f"{folder}: is not a folder of an exported policy: it has no {MANIFEST}; "
            "`ibrobot export CHECKPOINT --to onnx` writes one"
        ) from None
    except (OSError, ValueError, RecursionError) as error:
        raise PolicyError(f"{path}: cannot be read: {error}") from None
    return _Reader(path, content).manifest()


class _Reader:
    """Checks each value of a manifest."""

    def __init__(self, path: Path, content: Any) -> None:
        self._path, self._content = path, content

    def manifest(self) -> Manifest:
        content = self._content
        if not isinstance(content, dict):
            raise PolicyError(f"{self._path}: must be a JSON object, not {type(content).__name__}")
        if content.get("format") != FORMAT:
            raise self._wrong("format", content.get("format"), f"{FORMAT}; export the checkpoint again")
        observations = self._value("observations", dict)
        if not observations:
            raise self._wrong("observations", observations, "not be empty")
        shapes = {key: self._shape(f"observations.{key}", shape) for key, shape in observations.items()}
        action_size = self._whole("action_size", 1, 10_000)
        chunk_size = self._whole("chunk_size", 1, 10_000)
        noise = self._noise()
        steps = tuple(self._step(i, step) for i, step in enumerate(self._value("denoising_steps", list)))
        if len(steps) > _MAX_STEPS:
            raise self._wrong("denoising_steps", f"a list of {len(steps)}", f"have at most {_MAX_STEPS}")
        if steps and (noise is None or noise.distribution != "normal" or noise.shape[-1:] != (action_size,)):
            raise self._wrong(NOISE, content.get(NOISE), f"be normal, of shape (horizon, {action_size})")
        graphs = self._value("graphs", list)
        if len(graphs) != (2 if steps else 1) or not all(isinstance(g, str) and _FILE.fullmatch(g) for g in graphs):
            wanted = "two files" if steps else "one file"
            raise self._wrong("graphs", graphs, f"be plain names of {wanted} that end in .onnx")
        contract, norm_mode = self._trained()
        clip = content.get("clip")
        if clip is not None and not (_finite(clip) and clip > 0):
            raise self._wrong("clip", clip, "be a positive number, or null")
        return Manifest(
            self._path, self._value("type", str), shapes, self._whole("history", 0, _MAX_STEPS), action_size,
            chunk_size, self._whole("first", 0, _MAX_STEPS), self._numbers("scale", action_size),
            self._numbers("offset", action_size), tuple(graphs), noise, clip, steps, contract, norm_mode, content,
        )  # fmt: skip

    def _wrong(self, key: str, value: Any, wanted: str) -> PolicyError:
        shown = repr(value)
        return PolicyError(f"{self._path}: {key} is {shown[:80]}{'…' * (len(shown) > 80)}, must {wanted}")

    def _value(self, key: str, kind: type) -> Any:
        value = self._content.get(key)
        if not isinstance(value, kind):
            raise self._wrong(key, value, f"be a JSON value of type {kind.__name__}")
        return value

    def _whole(self, key: str, least: int, most: int) -> int:
        value = self._value(key, int)
        if isinstance(value, bool) or not least <= value <= most:
            raise self._wrong(key, value, f"be a whole number from {least} to {most}")
        return int(value)

    def _shape(self, key: str, value: Any) -> tuple[int, ...]:
        whole = isinstance(value, list) and all(type(n) is int and 0 < n <= _MAX_SIZE for n in value)
        if not whole or not value or math.prod(value) > _MAX_SIZE:
            raise self._wrong(key, value, f"be a shape of at most {_MAX_SIZE} elements")
        return tuple(value)

    def _numbers(self, key: str, size: int) -> NDArray[np.float64]:
        value = self._value(key, list)
        if len(value) != size or not all(_finite(number) for number in value):
            raise self._wrong(key, value, f"be {size} finite numbers")
        return np.array(value, np.float64)

    def _noise(self) -> Noise | None:
        value = self._content.get(NOISE)
        if value is None:
            return None
        if not isinstance(value, dict) or value.get("distribution") not in ("normal", "uniform"):
            raise self._wrong(NOISE, value, "have a shape and a distribution, normal or uniform")
        return Noise(value["distribution"], self._shape(f"{NOISE}.shape", value.get("shape")))

    def _step(self, index: int, value: Any) -> DenoisingStep:
        key, size = f"denoising_steps[{index}]", len(attrs.fields(DenoisingStep))
        numbers = isinstance(value, list) and len(value) == size and all(map(_finite, value))
        if not numbers or type(value[0]) is not int:
            raise self._wrong(key, value, f"be a time and {size - 1} finite numbers")
        return DenoisingStep(*value)

    def _trained(self) -> tuple[Contract | None, str | None]:
        trained = self._value("trained_on", dict)
        if not trained:
            return None, None
        try:
            return Contract.from_canonical(trained["contract"]), str(trained["conversion"]["norm_mode"])
        except (KeyError, TypeError, ValueError, AttributeError, ContractError) as error:
            raise PolicyError(f"{self._path}: trained_on does not describe a dataset: {error!r}") from None


def _finite(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def stacked_shape(manifest: Manifest, key: str) -> tuple[int, ...]:
    """Shape of one request's input `key`: with a history, its first dimension counts the ticks."""
    shape = manifest.observations[key]
    return (manifest.history + 1, *shape) if manifest.history else shape

"""Policies: what turns observations into chunks of actions, in three pure steps."""

from __future__ import annotations

import hashlib
import json
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray

from ibrobot_core.robot import Vector

Tensors = Mapping[str, NDArray[np.generic]]


@attrs.frozen(eq=False)
class Frame:
    """One tick's observations: key -> array, and the keys that are missing at this tick.

    `values` has only what is there; images are (H, W, C) uint8, vectors (N,) float32. Nothing is ever filled in.
    """

    stamp_ns: int
    values: Mapping[str, NDArray[np.generic]]
    missing: frozenset[str] = frozenset()
    prompt: str = ""
    prefix: Vector | None = None
    """The commands of the arm from this tick on, shape (K, A) with 1 <= K <= `chunk_size`, in the contract's units
    and order; row i is for the same time as action i of the chunk. It is the actions still in the plan, never padded;
    where the plan ran dry, the last one, which is held meanwhile. None at the beginning, and for a policy that does
    not want it."""
    delay_steps: int = 0
    """The latency to expect, in actions: so many of the prefix, 0 <= delay_steps <= K, are executed before the chunk
    comes."""
    history: tuple[Frame, ...] = ()
    """The frames of the ticks just before, oldest first, each complete and without prompt, prefix and history of its
    own; at most `PolicySpec.history` of them, fewer where an episode begins or an observation was missing."""


@attrs.frozen
class PolicySpec:
    """What a policy needs and gives, compared with the contract before anything moves."""

    observations: Mapping[str, tuple[int, ...]]
    """Keys that it reads, with their shapes; -1 stands for any size."""
    actions: tuple[str, ...] | None
    """Joint names of the action vector in order; None when the checkpoint does not say."""
    action_size: int
    chunk_size: int
    """The most actions that a chunk has."""
    rate_hz: float | None = None
    """Rate of the actions in a chunk [Hz]; None: the contract's."""
    prompt: bool = False
    """Whether it wants a prompt."""
    prefix: bool = False
    """Whether it continues `Frame.prefix`: its chunk follows the first `delay_steps` actions of the prefix, and leads
    from there to what it would do by itself (real-time chunking)."""
    stateful: bool = False
    """Whether `infer` remembers the earlier requests of an episode, until `reset`. Such a policy serves one robot at a
    time."""
    history: int = 0
    """How many ticks before the frame's own it sees, in `Frame.history`."""
    contract: Mapping[str, Any] | None = None
    """What `Contract.canonical` gave of the contract that it was trained on; None when the checkpoint does not say."""
    norm_mode: str | None = None
    """Unit of joint positions that it was trained in, as under `models`; None when the checkpoint does not say."""


def copied_tensors(tensors: Tensors) -> dict[str, NDArray[np.generic]]:
    """The same arrays in memory of their own, e.g. outputs that the next `infer` would overwrite."""
    return {name: np.array(array) for name, array in tensors.items()}


class PictureCodec(ABC):
    """JPEG for tensors that are camera pictures: `uint8`, shape (H, W, 3) or (H, W, 1)."""

    @abstractmethod
    def encode(self, name: str, picture: NDArray[np.uint8]) -> bytes | None:
        """The picture as JPEG; None where the tensor of this name is to stay as it is."""

    @abstractmethod
    def decode(self, jpeg: memoryview, shape: tuple[int, int, int]) -> NDArray[np.uint8]:
        """The picture of a JPEG, which is to be refused before it is decoded where its size is not `shape`."""


class Policy(ABC):
    """Three steps, so that `infer` can run in another process or on another machine than the other two.

    The constructor reads configuration and statistics only; `load` reads the weights. Where `infer` runs elsewhere, the
    robot's side is constructed, reset, and asked to `preprocess` and `postprocess`, but never loaded.

    `infer` is pure: whatever it depends on comes in its tensors, e.g. the seed of its noise, so that one server answers
    many robots, and one that was restarted goes on. Earlier observations come in `Frame.history`. A policy whose
    `infer` remembers all the same says so by `PolicySpec.stateful`.
    """

    spec: PolicySpec

    @abstractmethod
    def preprocess(self, frame: Frame) -> Tensors:
        """Observations -> the network's inputs.

        Raises:
            PolicyError: when the frame lacks a key that the policy needs.
        """

    def check(self, tensors: Tensors) -> None:
        """Check that a request, which may come from anywhere, has what `preprocess` makes; does nothing by default.

        A server asks before it resets a policy that remembers for another robot.

        Raises:
            PolicyError: with what is missing or of another dtype or shape.
        """

    @abstractmethod
    def infer(self, tensors: Tensors) -> Tensors:
        """Inputs -> raw outputs. The heavy step.

        Tensors are plain arrays of booleans, integers or floats; those that came from elsewhere cannot be written to.
        Outputs may be overwritten by the next call: whoever keeps them copies them.
        """

    @abstractmethod
    def postprocess(self, tensors: Tensors) -> NDArray[np.float64]:
        """Raw outputs -> actions, shape (N, A) with 1 <= N <= `chunk_size`, in the contract's units and order."""

    def infer_batch(self, batch: Sequence[Tensors]) -> list[Tensors]:
        """Outputs of several inputs, in their order. All inputs have the same names, dtypes and shapes.

        One after the other by default. The outputs of a batch share no memory; the next call may overwrite them.
        """
        return [copied_tensors(self.infer(tensors)) for tensors in batch]

    def fingerprint(self) -> str:
        """What both sides of `infer` must agree on; of the spec, where a policy does not add e.g. its statistics' hash.

        Known once constructed, without the weights, which the robot's side may lack. It has at most 128 bytes.
        """
        spec = attrs.asdict(self.spec)
        return hashlib.sha256(json.dumps(spec, sort_keys=True).encode()).hexdigest()[:16]

    def weights(self) -> str:
        """Hash of the weights that `load` read; empty before, and for a policy that has none. At most 128 bytes."""
        return ""

    def picture_codec(self, quality: int = 90) -> PictureCodec | None:
        """What makes JPEG of the pictures among its inputs, and pictures of JPEG, for thin links.

        Args:
            quality: of the JPEG, 1 to 100.

        Returns:
            The codec; None where `preprocess` gives no pictures as they are, which is the default.
        """
        return None

    def check_weights(self) -> None:
        """See, without loading them, that the weights are there and fit the configuration, as far as that is quick.

        Raises:
            PolicyError: where they are not.
        """

    def load(self) -> None:
        """Load weights and warm up; when it returns the policy is ready.

        Raises:
            PolicyError: e.g. no such checkpoint.
        """

    def reset(self, seed: int) -> None:
        """A new episode begins; forget the last."""

    def close(self) -> None:
        """Release memory and devices. Safe to call twice."""

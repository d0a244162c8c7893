"""Policies: what turns observations into chunks of actions, in three pure steps."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping

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
    """The plan's actions still to be executed from this tick on, shape (K, A) with 1 <= K <= `chunk_size`, in the
    contract's units and order: row i is for the same time as action i of the chunk. None where nothing is planned, or
    the policy does not want it; never padded."""
    delay_steps: int = 0
    """The latency to expect, in actions: so many of the prefix, 0 <= delay_steps <= K, are executed before the chunk
    comes."""


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


class Policy(ABC):
    """Three pure steps, so that `infer` can run in another process or on another machine."""

    spec: PolicySpec

    @abstractmethod
    def preprocess(self, frame: Frame) -> Tensors:
        """Observations -> the network's inputs.

        Raises:
            PolicyError: when the frame lacks a key that the policy needs.
        """

    @abstractmethod
    def infer(self, tensors: Tensors) -> Tensors:
        """Inputs -> raw outputs. The heavy step. Pure but for the state that `reset` clears."""

    @abstractmethod
    def postprocess(self, tensors: Tensors) -> NDArray[np.float64]:
        """Raw outputs -> actions, shape (N, A) with 1 <= N <= `chunk_size`, in the contract's units and order."""

    def load(self) -> None:
        """Load weights and warm up; when it returns the policy is ready.

        Raises:
            PolicyError: e.g. no such checkpoint.
        """

    def reset(self, seed: int) -> None:
        """A new episode begins; forget the last."""

    def close(self) -> None:
        """Release memory and devices. Safe to call twice."""

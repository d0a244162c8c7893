"""Policies, which compute action chunks from observations in three pure steps, and the units of their vectors."""

from __future__ import annotations

import copy
import hashlib
import json
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray

from ibrobot_core.errors import PolicyError
from ibrobot_core.robot import Vector

Tensors = Mapping[str, NDArray[np.generic]]
ACTION = "action"
"""Key of the action vector."""


@attrs.frozen(eq=False)
class Frame:
    """The observations of one tick: key -> array, and the keys that are missing at this tick.

    `values` has only available observations: images are (H, W, C) uint8, vectors (N,) float32. Missing ones are never
    filled in.
    """

    stamp_ns: int
    values: Mapping[str, NDArray[np.generic]]
    missing: frozenset[str] = frozenset()
    prompt: str = ""
    prefix: Vector | None = None
    """The commands of the arm from this tick on, shape (K, A) with 1 <= K <= `chunk_size`, in the contract's units
    and order. Row i is for the same time as action i of the chunk. These are the actions still in the plan, without
    padding, or the held action if the plan ran dry. None at the beginning, and for policies that do not use it."""
    delay_steps: int = 0
    """The expected latency in actions: the number of actions of the prefix, 0 <= delay_steps <= K, that will be
    executed before the chunk arrives."""
    history: tuple[Frame, ...] = ()
    """The frames of the preceding ticks, oldest first, each complete and without prompt, prefix and history; at most
    `PolicySpec.history` of them, fewer at the start of an episode or after a missing observation."""

    def observation(self, key: str, shape: tuple[int, ...]) -> NDArray[Any]:
        """The value of an observation that a policy needs.

        Raises:
            PolicyError: if it is missing, has another shape, is not finite, or if an image does not have 8-bit pixels.
        """
        if (value := self.values.get(key)) is None:
            raise PolicyError(f"the policy needs {key}, which the frame at {self.stamp_ns} ns lacks")
        if value.shape != shape:
            raise PolicyError(f"the policy needs {key} of shape {shape}, got {value.shape}")
        if len(shape) == 3 and value.dtype != np.uint8:
            raise PolicyError(f"the policy needs {key} with 8-bit pixels, got {value.dtype}")
        Policy.check_finite("the observation", {key: value})
        return value


@attrs.frozen
class PolicySpec:
    """Inputs and outputs of a policy, compared with the contract before anything moves."""

    observations: Mapping[str, tuple[int, ...]]
    """Keys of the inputs, with their shapes; -1 means any size."""
    actions: tuple[str, ...] | None
    """Joint names of the action vector, in order; None if the checkpoint does not state them."""
    action_size: int
    chunk_size: int
    """Maximum number of actions in a chunk."""
    rate_hz: float | None = None
    """Rate of the actions in a chunk [Hz]; None: the contract's."""
    prompt: bool = False
    """Whether it takes a prompt."""
    prefix: bool = False
    """Whether it continues `Frame.prefix` (real-time chunking): its chunk begins with the first `delay_steps` actions
    of the prefix and continues smoothly from there."""
    stateful: bool = False
    """Whether the result of `infer` depends on earlier requests since `reset`. Such a policy serves one robot at a
    time."""
    history: int = 0
    """Number of earlier ticks that it uses, in `Frame.history`."""
    contract: Mapping[str, Any] | None = None
    """`Contract.canonical` of the contract that it was trained on; None if the checkpoint does not state it."""
    norm_mode: str | None = None
    """Unit of joint positions in training, as under `models`; None if the checkpoint does not state it."""


def _fits(shape: tuple[int, ...], wanted: tuple[int, ...]) -> bool:
    return len(shape) == len(wanted) and all(n == m or (m == -1 and n > 0) for n, m in zip(shape, wanted, strict=True))


class PictureCodec(ABC):
    """JPEG for tensors that are camera images: `uint8`, shape (H, W, 3) or (H, W, 1)."""

    @abstractmethod
    def encode(self, name: str, picture: NDArray[np.uint8]) -> bytes | None:
        """Encode an image as JPEG; returns None if the tensor of this name must not be encoded."""

    @abstractmethod
    def decode(self, jpeg: memoryview, shape: tuple[int, int, int]) -> NDArray[np.uint8]:
        """Decode a JPEG. It must be refused before decoding if its size is not `shape`."""


class Policy(ABC):
    """A policy in three steps, so that `infer` can run in a different process or machine than the other two.

    The constructor reads configuration and statistics only; `load` reads the weights. If `infer` runs elsewhere, the
    policy on the robot is constructed and reset, and it preprocesses and postprocesses, but it is never loaded.

    `infer` is pure: its result depends only on its tensors, which include e.g. the seed of its noise. So one server can
    serve many robots, and a restarted server can continue. Earlier observations are in `Frame.history`. A policy whose
    `infer` does depend on earlier requests must set `PolicySpec.stateful`.
    """

    spec: PolicySpec

    @abstractmethod
    def preprocess(self, frame: Frame) -> Tensors:
        """Convert observations to the network's inputs.

        Raises:
            PolicyError: if the frame lacks a key that the policy needs.
        """

    def check(self, tensors: Tensors) -> None:
        """Check that a request, possibly from an untrusted client, has the tensors of `preprocess`.

        Does nothing by default. A server calls it before it resets a stateful policy for another robot.

        Raises:
            PolicyError: if tensors are missing or have a wrong dtype or shape; names them.
        """

    @staticmethod
    def check_finite(stage: str, tensors: Tensors) -> None:
        """Check that no tensor has NaN or infinity.

        Args:
            stage: what made them, for the error, e.g. `the policy's infer`.
            tensors: name -> array; only floats are checked.

        Raises:
            PolicyError: names the stage, and the first value that is not finite.
        """
        for name, array in tensors.items():
            if array.dtype.kind == "f" and not np.isfinite(array).all():
                index = np.argwhere(~np.isfinite(array))[0].tolist()
                raise PolicyError(f"{stage}: {name}{index or ''} is {array[tuple(index)]}, must be finite")

    def check_tensors(
        self,
        tensors: Tensors,
        expected: Mapping[str, tuple[np.dtype[Any], tuple[int, ...]]],
        *,
        others: bool = False,
    ) -> None:
        """For `check`: check that a request has the tensors that `preprocess` makes.

        Args:
            tensors: the request.
            expected: name -> dtype and shape; -1 in a shape means any size except 0.
            others: whether it may have tensors of other names.

        Raises:
            PolicyError: names all tensors that do not fit.
        """
        wrong = []
        for name, (dtype, shape) in expected.items():
            array = tensors.get(name)
            if array is None or array.dtype != dtype or not _fits(array.shape, shape):
                got = "is missing" if array is None else f"is {array.dtype} {array.shape}"
                wrong.append(f"{name} {got}, must be {dtype} {shape}")
        if not others:
            wrong += [f"{name} is unknown" for name in tensors if name not in expected]
        if wrong:
            raise PolicyError(f"the request's tensors: {'; '.join(wrong)}")

    @abstractmethod
    def infer(self, tensors: Tensors) -> Tensors:
        """Compute raw outputs from inputs. The heavy step.

        Tensors are plain arrays of booleans, integers or floats; received ones are read-only. The next call may
        overwrite the outputs, so copy them to keep them.
        """

    @abstractmethod
    def postprocess(self, tensors: Tensors) -> NDArray[np.float64]:
        """Convert outputs to actions: a new array (N, A), 1 <= N <= `chunk_size`, in the contract's units and order."""

    def infer_batch(self, batch: Sequence[Tensors]) -> list[Tensors]:
        """Compute the outputs of several inputs, in order. All inputs have the same names, dtypes and shapes.

        By default, one after the other. The outputs of a batch share no memory; the next call may overwrite them.
        """
        return [copy.deepcopy(dict(self.infer(tensors))) for tensors in batch]

    def fingerprint(self) -> str:
        """Fingerprint on which both sides of `infer` must agree: by default of the spec; policies may add statistics.

        Available after construction, without weights, which the robot may not have. At most 128 bytes.
        """
        spec = attrs.asdict(self.spec)
        return hashlib.sha256(json.dumps(spec, sort_keys=True).encode()).hexdigest()[:16]

    def weights(self) -> str:
        """Hash of the loaded weights; empty before `load`, and for a policy without weights. At most 128 bytes."""
        return ""

    def identity(self) -> str:
        """Name and version of the server or library that computes the answers, for recordings. By default empty.

        At most 1,024 bytes; available after `load`.
        """
        return ""

    def picture_codec(self, quality: int = 90) -> PictureCodec | None:
        """The JPEG codec for images among its inputs, for slow links.

        Args:
            quality: JPEG quality, 1 to 100.

        Returns:
            The codec; None, the default, if the tensors of `preprocess` contain no unprocessed images.
        """
        return None

    def check_weights(self) -> None:
        """Check quickly, without loading them, that the weights exist and fit the configuration.

        Raises:
            PolicyError: if they do not.
        """

    def load(self) -> None:
        """Load weights and warm up; afterwards the policy is ready.

        Raises:
            PolicyError: e.g. if the checkpoint does not exist.
        """

    def reset(self, seed: int) -> None:
        """Begin a new episode and discard the state of the last one."""

    def close(self) -> None:
        """Release memory and devices. Safe to call twice."""


class PolicyVectors:
    """Converts observations and actions between the robot and a policy. This class changes nothing: all in radians."""

    needs: tuple[str, ...] = ()
    """Keys of observations that `commands` needs, whatever the policy reads."""

    def __call__(self, values: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        """Convert values of a tick from radians to the unit; joints on the last axis. Copies arrays that change."""
        return dict(values)

    def frame(self, frame: Frame) -> Frame:
        """Convert a frame with its history and prefix to the unit."""
        return frame

    def commands(self, actions: Vector, seen: Mapping[str, NDArray[Any]], start: Vector) -> tuple[Vector, int]:
        """The positions of the joints [rad], shape (N, A), that actions of a policy command, and how many it held.

        Args:
            actions: in the policy's units, shape (N, F).
            seen: the observations for which the policy gave them, in radians.
            start: the joints' commands before them [rad], shape (A,).
        """
        return self.radians(ACTION, actions), 0

    def check(self, spec: PolicySpec) -> None:
        """Raise ContractError if a policy cannot give actions of this form; any can give positions of joints."""

    def radians(self, key: str, value: NDArray[Any]) -> NDArray[Any]:
        """Convert the vectors of one key from the unit to radians; joints on the last axis."""
        return value

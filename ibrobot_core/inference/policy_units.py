"""A policy whose vectors are in another unit than the contract's: converted on the way in, and back on the way out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import override

import attrs
import numpy as np
from numpy.typing import NDArray

from ibrobot_core.contract.joint_units import ACTION, JointUnits
from ibrobot_core.interfaces import Frame, PictureCodec, Policy, Tensors


class PolicyInItsUnits(Policy):
    """Radians outside, the policy's own unit inside.

    Args:
        policy: sees and gives joint positions in the unit of `units`.
        units: the conversion of the robot's contract.
    """

    def __init__(self, policy: Policy, units: JointUnits) -> None:
        self._policy = policy
        self._units = units
        self.spec = policy.spec

    @override
    def check_weights(self) -> None:
        self._policy.check_weights()

    @override
    def load(self) -> None:
        self._policy.load()

    @override
    def reset(self, seed: int) -> None:
        self._policy.reset(seed)

    @override
    def close(self) -> None:
        self._policy.close()

    @override
    def fingerprint(self) -> str:
        return self._policy.fingerprint()

    @override
    def weights(self) -> str:
        return self._policy.weights()

    @override
    def picture_codec(self, quality: int = 90) -> PictureCodec | None:
        return self._policy.picture_codec(quality)

    @override
    def preprocess(self, frame: Frame) -> Tensors:
        prefix = None if frame.prefix is None else self._units({ACTION: frame.prefix})[ACTION]
        history = tuple(self._converted(each) for each in frame.history)
        return self._policy.preprocess(attrs.evolve(self._converted(frame), prefix=prefix, history=history))

    @override
    def check(self, tensors: Tensors) -> None:
        self._policy.check(tensors)

    @override
    def infer(self, tensors: Tensors) -> Tensors:
        return self._policy.infer(tensors)

    @override
    def infer_batch(self, batch: Sequence[Tensors]) -> list[Tensors]:
        return self._policy.infer_batch(batch)

    @override
    def postprocess(self, tensors: Tensors) -> NDArray[np.float64]:
        return self._units.radians(ACTION, self._policy.postprocess(tensors))

    def _converted(self, frame: Frame) -> Frame:
        return attrs.evolve(frame, values=self._units(frame.values))

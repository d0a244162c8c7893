"""Targets of inverse kinematics, and the distance of the tip from them."""

from __future__ import annotations

import attrs
import numpy as np

from ibrobot_core.api import Vector
from ibrobot_kinematics.model import TipPose

_ORTHONORMAL = 1e-6


@attrs.frozen(eq=False)
class Target:
    """A target of the tip: a position, alone or with an orientation or the direction of one axis.

    Raises:
        ValueError: if a value has a wrong shape, is not finite, or is not a rotation matrix or unit vector, or if both
            `rotation` and `axis` are given.
    """

    position: Vector = attrs.field(converter=np.asarray)
    """Origin of the tip in the base frame [m], shape (3,)."""
    rotation: Vector | None = attrs.field(default=None, converter=attrs.converters.optional(np.asarray))
    """Axes of the tip in the base frame, as columns, shape (3, 3)."""
    axis: Vector | None = attrs.field(default=None, converter=attrs.converters.optional(np.asarray))
    """Direction of the tip's z axis in the base frame, a unit vector, shape (3,); suits five joints."""

    def __attrs_post_init__(self) -> None:
        for name, value, shape in (
            ("position", self.position, (3,)),
            ("rotation", self.rotation, (3, 3)),
            ("axis", self.axis, (3,)),
        ):
            if value is not None and (np.shape(value) != shape or not np.isfinite(value).all()):
                raise ValueError(f"{name} must be finite with shape {shape}, got {np.asarray(value).tolist()}")
        if self.rotation is not None:
            if self.axis is not None:
                raise ValueError("a target has a rotation or an axis, not both")
            if np.abs(self.rotation.T @ self.rotation - np.eye(3)).max() > _ORTHONORMAL or (
                np.linalg.det(self.rotation) < 0
            ):
                raise ValueError(f"rotation must be a rotation matrix, got {self.rotation.tolist()}")
        if self.axis is not None and abs(np.linalg.norm(self.axis) - 1) > _ORTHONORMAL:
            raise ValueError(f"axis must be a unit vector, got {self.axis.tolist()}")

    @property
    def columns(self) -> Vector:
        """The position and the specified directions, shape (K, 3)."""
        if self.rotation is not None:
            return np.vstack([self.position, self.rotation.T])
        return self.position[None] if self.axis is None else np.vstack([self.position, self.axis])

    def columns_of(self, tip: TipPose) -> Vector:
        """The equivalent of `columns` for a tip, shape (…, K, 3)."""
        position = tip.position[..., None, :]
        if self.rotation is not None:
            return np.concatenate([position, tip.rotation.mT], axis=-2)
        return position if self.axis is None else np.concatenate([position, tip.rotation[..., None, :, 2]], axis=-2)

    def missed(self, tip: TipPose) -> tuple[Vector, Vector]:
        """Distance [m] and angle [rad] of the tip from the target, both of shape (…)."""
        difference = self.columns_of(tip) - self.columns
        chord = np.sqrt((difference[..., 1:, :] ** 2).sum(axis=(-2, -1)))
        # The total error of three axes is that of one perpendicular axis times the square root of 2.
        diameter = 2.0 if self.rotation is None else 2.0 * np.sqrt(2)
        return np.linalg.norm(difference[..., 0, :], axis=-1), 2 * np.arcsin(np.minimum(chord / diameter, 1.0))

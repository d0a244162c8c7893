"""What kinematics raises."""

from __future__ import annotations

from ibrobot_core.api import IbrobotError, Vector


class KinematicsError(IbrobotError):
    """A model that cannot be used, e.g. an MJCF without the tip's site."""


class UnreachableError(KinematicsError):
    """A target that the arm cannot reach within its joint limits and the tolerances.

    Args:
        message: the target, and how far off the nearest solution is.
        nearest: joint positions [rad] of the nearest solution found, shape (J,).
        position_error: distance [m] of the tip from the target there.
        rotation_error: angle [rad] between the tip and the target there; 0 for a target without an orientation.
    """

    def __init__(self, message: str, nearest: Vector, position_error: float, rotation_error: float) -> None:
        super().__init__(message)
        self.nearest = nearest
        self.position_error = position_error
        self.rotation_error = rotation_error

"""Errors of kinematics."""

from __future__ import annotations

import math

from ibrobot_core.api import IbrobotError, Vector

_MANY_DIGITS = 1e4
"""Larger lengths [m] are written with an exponent."""


class KinematicsError(IbrobotError):
    """A model is unusable, e.g. an MJCF lacks the tip's site."""


class UnreachableError(KinematicsError):
    """The arm cannot reach a target within its joint limits and the tolerances.

    The nearest point minimises the position error; if the arm reaches the position, it minimises the orientation error.

    Args:
        tip: name of the tip's frame.
        target: position of the target [m], shape (3,).
        nearest: joint positions [rad or m] of the nearest point, shape (J,).
        position: position of the tip there [m], shape (3,).
        position_error: distance [m] of the tip from the target there.
        rotation_error: angle [rad] between the tip and the target there; 0 for a target without an orientation.
    """

    def __init__(
        self, tip: str, target: Vector, nearest: Vector, position: Vector, position_error: float, rotation_error: float
    ) -> None:
        turned = f" and {math.degrees(rotation_error):.1f} degrees" if rotation_error else ""
        super().__init__(
            f"{tip} cannot reach {_point(target)} as asked within the joint limits; the nearest is {_point(position)},"
            f" {_off(position_error)}{turned} off"
        )
        self.nearest = nearest
        self.position = position
        self.position_error = position_error
        self.rotation_error = rotation_error


def _point(position: Vector) -> str:
    x, y, z = (f"{value:.3f}" if abs(value) < _MANY_DIGITS else f"{value:.6g}" for value in position)
    return f"({x}, {y}, {z}) m"


def _off(distance: float) -> str:
    return f"{1000 * distance:.1f} mm" if distance < _MANY_DIGITS else f"{distance:.6g} m"

"""Detectors: what they look at, and what they find."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

import attrs
import numpy as np
from ibrobot_kinematics.poses import matrix
from numpy.typing import NDArray

from ibrobot_core.api import Descriptor, Pose, Vector
from ibrobot_core.app import RunView

KIND = "detector"
"""The kind of plugin, with the hook `ibrobot_detectors`."""


@attrs.frozen(eq=False)
class Sight:
    """What is known of a camera now."""

    camera: str
    stamp_ns: int
    pixels: NDArray[np.uint8] | None
    """Its picture, shape (height, width, 3), RGB; None for detectors that look at none."""
    size: tuple[int, int]
    """Width and height [px]."""
    intrinsics: Vector
    """Shape (3, 3) [px]; the centre of the first pixel is at (0, 0)."""
    distortion: Vector
    """Of ROS's `plumb_bob`: k1, k2, p1, p2, k3, shape (5,)."""
    pose: Vector
    """Of the camera's optical frame (z ahead, x right, y down) in the base frame, shape (4, 4)."""

    def seen(self, points: Vector) -> Vector | None:
        """Where the camera sees points of the base frame.

        Args:
            points: [m], shape (N, 3).

        Returns:
            Pixels, shape (N, 2); None if a point is behind the camera.
        """
        there = (points - self.pose[:3, 3]) @ self.pose[:3, :3]
        if there[:, 2].min() <= 0:
            return None
        x, y = (there[:, :2] / there[:, 2:]).T
        k1, k2, p1, p2, k3 = self.distortion
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        bent_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        bent_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        pixels = np.column_stack([bent_x, bent_y, np.ones_like(x)]) @ self.intrinsics.T
        return np.asarray(pixels[:, :2])


@attrs.frozen
class Seen:
    """Where a camera sees an object."""

    camera: str
    box_px: tuple[float, float, float, float]
    """Left, top, right and bottom [px]."""


@attrs.frozen
class Detection:
    """An object that a detector has found."""

    name: str
    pose: Pose
    """In the base frame."""
    size_m: tuple[float, ...] = ()
    """Lengths along its axes [m]; empty if they are not known."""
    score: float = 1.0
    """0 to 1: how sure the detector is."""
    seen: tuple[Seen, ...] = ()


class Detector(ABC):
    """Finds objects. `find` may be called from several threads, one at a time."""

    @abstractmethod
    def find(self, name: str, sights: Sequence[Sight]) -> Sequence[Detection]:
        """Find objects.

        Args:
            name: what to look for, in words; empty for all that it knows.
            sights: the cameras with intrinsics and a pose; none of them if there are no such cameras.

        Returns:
            What it has found, the surest first; with `seen` for cameras that see it.

        Raises:
            IbrobotError: if it cannot look, with what to do.
        """

    def close(self) -> None:
        """Release what it holds; by default nothing. Safe to call twice."""


@attrs.frozen
class DetectorDescriptor(Descriptor[Detector]):
    """A detector; `ibrobot_detect.suite.DetectorSuite` checks it."""

    make: Callable[[Any, RunView], Detector] = attrs.field(kw_only=True)  # type: ignore[assignment]
    """Options and the run -> the detector."""
    pictures: bool = attrs.field(default=True, kw_only=True)
    """Whether it looks at pictures."""


def box_of(sight: Sight, pose: Pose, half: Sequence[float]) -> Seen | None:
    """Where a camera sees a box about an object; None if that is not in its picture.

    Args:
        sight: the camera.
        pose: of the object in the base frame.
        half: half the lengths of the box along the object's axes [m], shape (3,).
    """
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * np.asarray(half)
    placed = matrix(pose)
    pixels = sight.seen(corners @ placed[:3, :3].T + placed[:3, 3])
    if pixels is None:
        return None
    (left, top), (right, bottom) = pixels.min(axis=0).tolist(), pixels.max(axis=0).tolist()
    width, height = sight.size
    if right < 0 or bottom < 0 or left > width - 1 or top > height - 1:
        return None
    return Seen(sight.camera, (round(left, 1), round(top, 1), round(right, 1), round(bottom, 1)))


def fits(name: str, known: Sequence[str]) -> list[str]:
    """The known names that a text means: the same one, or else those that it has, or that have it.

    `the red cube` means `cube`, if there is no `the red cube`.
    """
    wanted, words = _words(name), {each: _words(each) for each in known}
    same = [each for each in known if words[each] == wanted]
    return same or [each for each in known if words[each] in wanted or wanted in words[each]]


def _words(text: str) -> str:
    """The words of a text, with a space before and after each."""
    return f" {' '.join(''.join(each if each.isalnum() else ' ' for each in text.casefold()).split())} "

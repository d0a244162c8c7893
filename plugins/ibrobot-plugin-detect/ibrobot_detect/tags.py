"""The detector `apriltag`."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from functools import cache
from typing import Any, override

import numpy as np
from ibrobot_kinematics.poses import homogeneous, matrix, pose, pose_at
from numpy.typing import NDArray

from ibrobot_core.api import MissingDependency, SensorError, Vector, how_to_install
from ibrobot_core.app import RunView
from ibrobot_detect.detector import Detection, Detector, Seen, Sight, box_of, fits
from ibrobot_detect.options import Tag, TagOptions

try:
    from pupil_apriltags import Detector as Apriltags
except ModuleNotFoundError:  # there are no wheels for some processors
    raise MissingDependency(
        "the Python package pupil-apriltags is not installed",
        remedy=f"{how_to_install('pupil-apriltags')} compiles it",
    ) from None

_SURE = 100.0
"""Contrast of a tag's cells from which the detector is sure."""
_LEAST_PX = 16
"""Least width and height of a picture that can show the cells of a tag; the library crashes on one or two rows."""
_FLIP = np.diag([1.0, -1.0, -1.0])
"""The frame of the options, y up and z out of the tag, in that of the library, y down and z into it."""


class _Library(Apriltags):  # type: ignore[misc]  # the library brings no types
    """The library for one family of tags, which the process keeps: its own end frees memory that it then reads."""

    def __del__(self) -> None:
        """Free nothing."""


@cache
def _library(family: str) -> tuple[_Library, threading.Lock]:
    """The library for a family, and what is held while it is used."""
    return _Library(family, quad_decimate=1.0), threading.Lock()


class TagDetector(Detector):
    """Finds objects by their tags, in the camera that sees the tag with the greatest contrast.

    Pictures of lenses with distortion are straightened first, since the library knows none.

    Args:
        options: the objects with their tags.
        run: the run.
    """

    def __init__(self, options: TagOptions, run: RunView) -> None:
        self._options = options
        self._objects = {each.id: (name, each) for name, each in options.tags.items()}
        self._library, self._lock = _library(options.family)
        self._maps: dict[str, tuple[Any, Vector, NDArray[np.bool_]]] = {}
        """Camera -> what its map depends on, the place of each straight pixel, and whether that is in the picture."""

    @override
    def find(self, name: str, sights: Sequence[Sight]) -> Sequence[Detection]:
        wanted = fits(name, list(self._options.tags)) if name else list(self._options.tags)
        if not sights:
            raise SensorError(
                "no camera has both a calibration (`ibrobot camera calibrate`) and a known place (`transform` of the "
                "peripheral), so tags have no pose"
            )
        best: dict[str, tuple[float, Detection]] = {}
        for sight in sights if wanted else ():
            here: dict[str, Any] = {}
            for tag_seen in self._tags(sight):
                name_of, tag = self._objects[tag_seen.tag_id]
                margin = float(tag_seen.decision_margin)
                if name_of not in wanted or margin < self._options.margin:
                    continue
                if name_of in here:  # nobody knows which one is on the object
                    (x, y), (other_x, other_y) = here[name_of].center, tag_seen.center
                    raise SensorError(
                        f"camera {sight.camera} sees tag {tag.id} of {name_of!r} twice, at {x:.0f}, {y:.0f} and "
                        f"{other_x:.0f}, {other_y:.0f} px: remove or cover the one that is not on the object"
                    )
                here[name_of] = tag_seen
                detection = _placed(sight, name_of, tag, tag_seen)
                seen = best[name_of][1].seen if name_of in best else ()
                if name_of not in best or margin > best[name_of][0]:
                    best[name_of] = margin, detection
                margin_of, kept = best[name_of]
                best[name_of] = margin_of, _with(kept, (*seen, *detection.seen))
        return [each for _, each in sorted(best.values(), key=lambda each: -each[0])]

    def _tags(self, sight: Sight) -> list[Any]:
        """The known tags in a picture; those of one size are measured at a time."""
        assert sight.pixels is not None
        if min(sight.size) < _LEAST_PX:
            return []
        grey = np.ascontiguousarray(self._straight(sight) @ np.array([0.299, 0.587, 0.114]) + 0.5, dtype=np.uint8)
        k = sight.intrinsics
        centre = (k[0, 2] + 0.5, k[1, 2] + 0.5)  # the library's first pixel reaches from 0 to 1
        known: list[Any] = []
        for size in sorted({each.size for _, each in self._objects.values()}):
            with self._lock:
                tags = self._library.detect(grey, True, (k[0, 0], k[1, 1], *centre), size)
            of_size = {number for number, (_, each) in self._objects.items() if each.size == size}
            known += [each for each in tags if each.tag_id in of_size]
        return known

    def _straight(self, sight: Sight) -> Vector:
        """The picture as a pinhole with the same matrix would take it, shape (height, width, 3)."""
        assert sight.pixels is not None
        picture = np.asarray(sight.pixels, np.float64)
        if not sight.distortion.any():
            return picture
        key = (sight.size, sight.intrinsics.tobytes(), sight.distortion.tobytes())
        if sight.camera not in self._maps or self._maps[sight.camera][0] != key:
            width, height = sight.size
            x, y = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
            rays: Vector = np.column_stack([x.ravel(), y.ravel(), np.ones(x.size)]) @ np.linalg.inv(sight.intrinsics).T
            places = Sight("", 0, None, sight.size, sight.intrinsics, sight.distortion, np.eye(4)).seen(rays)
            assert places is not None
            inside = ((places >= 0) & (places <= np.array([width - 1, height - 1]))).all(axis=1)
            self._maps[sight.camera] = key, places, inside
        _, places, inside = self._maps[sight.camera]
        return _sampled(picture, places, inside)


def _sampled(picture: Vector, places: Vector, inside: NDArray[np.bool_]) -> Vector:
    """A picture at places between its pixels, by bilinear interpolation; black outside."""
    height, width, _ = picture.shape
    low = np.clip(np.floor(places).astype(int), 0, np.array([width - 2, height - 2]))
    right, down = (places - low).T[..., None]
    x, y = low.T
    upper = picture[y, x] * (1 - right) + picture[y, x + 1] * right
    lower = picture[y + 1, x] * (1 - right) + picture[y + 1, x + 1] * right
    return np.asarray(np.where(inside[:, None], upper * (1 - down) + lower * down, 0.0).reshape(picture.shape))


def _placed(sight: Sight, name: str, tag: Tag, tag_seen: Any) -> Detection:
    """The object of a tag that a camera sees."""
    of_tag = homogeneous(tag_seen.pose_R @ _FLIP, tag_seen.pose_t[:, 0])
    placed = pose(sight.pose @ of_tag @ matrix(pose_at(tag.xyz, tag.rpy)))
    if len(tag.object_size) == 3:
        seen = box_of(sight, placed, [each / 2 for each in tag.object_size])
    else:
        (left, top), (right, bottom) = tag_seen.corners.min(axis=0) - 0.5, tag_seen.corners.max(axis=0) - 0.5
        seen = Seen(sight.camera, (round(left, 1), round(top, 1), round(right, 1), round(bottom, 1)))
    score = min(1.0, float(tag_seen.decision_margin) / _SURE)
    return Detection(name, placed, tag.object_size, round(score, 3), () if seen is None else (seen,))


def _with(detection: Detection, seen: tuple[Seen, ...]) -> Detection:
    return Detection(detection.name, detection.pose, detection.size_m, detection.score, seen)

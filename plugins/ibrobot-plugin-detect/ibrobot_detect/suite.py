"""The conformance suite of detectors, and pictures for it; both need `ibrobot-testing`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import closing
from typing import ClassVar

import attrs
import numpy as np
from ibrobot_kinematics.poses import matrix
from ibrobot_kinematics.rotations import log
from ibrobot_testing.suite import Suite

from ibrobot_core.api import Pose
from ibrobot_detect.detector import Detection, Detector, Sight


class DetectorSuite(Suite[Detector]):
    """Checks of every `Detector`. A test defines `make`, `sights` and `objects`."""

    tolerance_m: ClassVar[float] = 0.005
    """Allowed distance of an object from where it is [m]."""
    tolerance_rad: ClassVar[float] = 0.05
    """Allowed angle between an object's orientation and the true one [rad]; pi where the detector knows none."""
    pictures: ClassVar[bool] = True
    """Whether it looks at pictures."""

    def sights(self) -> Sequence[Sight]:
        """Cameras that see all `objects`."""
        raise NotImplementedError(f"{type(self).__name__} must define sights(self)")

    def objects(self) -> Mapping[str, Pose]:
        """Name of an object -> its pose in the base frame; at least two, of which no name is part of another."""
        raise NotImplementedError(f"{type(self).__name__} must define objects(self)")

    def _found(self, name: str, sights: Sequence[Sight]) -> Sequence[Detection]:
        with closing(self.make(self.context())) as detector:
            return detector.find(name, sights)

    def test_finds_each_object_where_it_is(self) -> None:
        """Without a name, it finds all objects, each once, at its pose."""
        detections = self._found("", self.sights())
        assert sorted(each.name for each in detections) == sorted(self.objects())
        for each in detections:
            truth, there = matrix(self.objects()[each.name]), matrix(each.pose)
            away_m = float(np.linalg.norm(truth[:3, 3] - there[:3, 3]))
            assert away_m <= self.tolerance_m, f"{each.name} is found {away_m * 1000:.1f} mm from where it is"
            turned = float(np.linalg.norm(log(truth[:3, :3].T @ there[:3, :3])))
            assert turned <= self.tolerance_rad, f"{each.name} is found turned by {np.degrees(turned):.1f} degrees"

    def test_a_name_chooses(self) -> None:
        """It finds the object that is named, and no other; for a name that nothing has, nothing."""
        for name in self.objects():
            assert [each.name for each in self._found(name, self.sights())] == [name]
        assert not self._found("a thing that is not there", self.sights())

    def test_the_surest_comes_first(self) -> None:
        """Scores are from 0 to 1, and do not increase."""
        scores = [each.score for each in self._found("", self.sights())]
        assert all(0 <= each <= 1 for each in scores)
        assert scores == sorted(scores, reverse=True)

    def test_says_where_it_is_seen(self) -> None:
        """Each object is seen by a camera that was given, in a box of its picture's coordinates that contains it."""
        sights = {each.camera: each for each in self.sights()}
        for each in self._found("", list(sights.values())):
            assert each.seen, f"{each.name}: no camera is said to see it"
            for seen in each.seen:
                left, top, right, bottom = seen.box_px
                place = sights[seen.camera].seen(matrix(each.pose)[None, :3, 3])
                assert place is not None
                x, y = place[0]
                slack = 3.0  # of rounding
                assert left - slack <= x <= right + slack, f"{each.name}: the box does not contain it"
                assert top - slack <= y <= bottom + slack, f"{each.name}: the box does not contain it"

    def test_empty_pictures_show_nothing(self) -> None:
        """In black, white and noisy pictures it finds nothing. Only for detectors that look at pictures."""
        rng = np.random.default_rng(0)
        for sight in self.sights() if self.pictures else ():
            assert sight.pixels is not None
            shape = sight.pixels.shape
            for pixels in (np.zeros(shape), np.full(shape, 255), rng.integers(0, 256, shape)):
                assert not self._found("", [attrs.evolve(sight, pixels=pixels.astype(np.uint8))])

    def test_changes_no_picture(self) -> None:
        """Pictures are shared, and stay as they are."""
        sights = self.sights()
        before = [None if each.pixels is None else each.pixels.copy() for each in sights]
        self._found("", sights)
        for sight, pixels in zip(sights, before, strict=True):
            assert (sight.pixels is None) == (pixels is None)
            if sight.pixels is not None:
                np.testing.assert_array_equal(sight.pixels, pixels)

    def test_close_is_safe_to_call_twice(self) -> None:
        """`close` may be called twice."""
        detector = self.make(self.context())
        detector.close()
        detector.close()

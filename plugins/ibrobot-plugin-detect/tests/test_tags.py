"""AprilTags in pictures whose truth is known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import override

import attrs
import numpy as np
import pytest
from ibrobot_detect.detector import Detector, Sight
from ibrobot_detect.options import Tag, TagOptions
from ibrobot_detect.suite import DetectorSuite
from ibrobot_detect.tags import TagDetector
from ibrobot_kinematics.poses import homogeneous, matrix, pose, pose_at
from ibrobot_kinematics.rotations import from_rpy
from ibrobot_testing import make_session
from numpy.typing import NDArray

from ibrobot_core.api import Context, Pose, SensorError

from .pictures import FOCAL, camera, facing, photograph

ABOVE = homogeneous(from_rpy(np.pi - 0.2, 0.1, 0.3), np.array([0.25, 0.05, 0.6]))
"""A camera that looks down at a table."""
BENT = np.array([-0.28, 0.09, 0.0012, -0.0008, -0.011])
"""The distortion of a webcam with a wide lens."""
TAGS = {"cube": Tag(id=3, size=0.04, xyz=(0.0, 0.0, -0.02)), "bin": Tag(id=11, size=0.06, rpy=(0.0, 0.0, 0.4))}
PLACED = {
    3: (ABOVE @ facing(0.3, -0.2, 0.5, (-0.08, 0.02, 0.55)), 0.04),
    11: (ABOVE @ facing(-0.2, 0.35, -2.0, (0.1, -0.05, 0.6)), 0.06),
}


@cache
def seen_from_above() -> Sight:
    return photograph(camera(ABOVE), PLACED)


def detector(tags: Mapping[str, Tag], margin: float = 30.0) -> TagDetector:
    return TagDetector(TagOptions(dict(tags), margin=margin), make_session())


class TestTagDetector(DetectorSuite):
    tolerance_m, tolerance_rad = 0.003, 0.03

    @override
    def make(self, ctx: Context) -> Detector:
        return detector(TAGS)

    @override
    def sights(self) -> Sequence[Sight]:
        return [seen_from_above()]

    @override
    def objects(self) -> Mapping[str, Pose]:
        return {name: pose(PLACED[tag.id][0] @ matrix(pose_at(tag.xyz, tag.rpy))) for name, tag in TAGS.items()}


def errors(distortion: NDArray[np.float64] | None, count: int) -> NDArray[np.float64]:
    """Errors of a tag of 40 mm in random poses: across and along the camera's axis [mm], of its normal [degrees]."""
    rng = np.random.default_rng(7)
    looked, rows = detector({"cube": Tag(id=3, size=0.04)}), []
    for _ in range(count):
        far = rng.uniform(0.2, 0.7)
        place = (far * rng.uniform(-0.3, 0.3), far * rng.uniform(-0.2, 0.2), far)
        tilt, turn = rng.uniform(-0.9, 0.9, 2)
        truth = facing(tilt, turn, rng.uniform(-np.pi, np.pi), place)
        detections = looked.find("", [photograph(camera(np.eye(4), distortion), {3: (truth, 0.04)})])
        assert len(detections) == 1, f"the tag at {place} is not found"
        there = matrix(detections[0].pose)
        away = (there[:3, 3] - truth[:3, 3]) * 1000
        turned = np.degrees(np.arccos(np.clip(there[:3, 2] @ truth[:3, 2], -1, 1)))
        rows.append([np.hypot(*away[:2]), abs(away[2]), turned])
    return np.array(rows)


@pytest.mark.parametrize("distortion", [None, BENT], ids=["pinhole", "wide lens"])
def test_pose_of_a_tag_is_exact_to_millimetres(distortion: NDArray[np.float64] | None) -> None:
    across, along, turned = np.median(errors(distortion, 9), axis=0)
    assert across < 0.2
    assert along < 1.5
    assert turned < 0.5


def test_half_a_pixel_is_no_matter_of_taste() -> None:
    """A tag that is seen head on, at the camera's axis, is found there: both count pixels from the same place."""
    truth = facing(0, 0, 0, (0.0, 0.0, 0.4))
    detections = detector({"cube": Tag(id=3, size=0.08)}).find("", [photograph(camera(np.eye(4)), {3: (truth, 0.08)})])
    pixel_m = 0.4 / FOCAL
    assert np.abs(matrix(detections[0].pose)[:2, 3]).max() < 0.25 * pixel_m


def test_ignored_distortion_would_be_wrong() -> None:
    """The lens matters in these pictures, so that the test above says something."""
    truth = facing(0.2, 0.1, 0.3, (0.18, 0.12, 0.5))
    taken = photograph(camera(np.eye(4), BENT), {3: (truth, 0.04)})
    known = detector({"cube": Tag(id=3, size=0.04)})
    straight = matrix(known.find("", [taken])[0].pose)[:3, 3]
    bent = matrix(known.find("", [attrs.evolve(taken, distortion=np.zeros(5))])[0].pose)[:3, 3]
    assert np.linalg.norm(straight - truth[:3, 3]) < 0.003
    assert np.linalg.norm(bent - truth[:3, 3]) > 0.01


def test_camera_with_the_best_view_says_where_a_tag_is() -> None:
    truth = facing(0.3, 0.2, 0.5, (0.0, 0.0, 0.35))
    near = photograph(camera(np.eye(4), name="near"), {3: (truth, 0.04)})
    far_pose = homogeneous(np.eye(3), np.array([0.0, 0.0, -0.5]))
    far = photograph(camera(far_pose, name="far"), {3: (truth, 0.04)})
    for sights in ([near, far], [far, near]):
        detections = detector({"cube": Tag(id=3, size=0.04)}).find("cube", sights)
        assert {each.camera for each in detections[0].seen} == {"near", "far"}
        assert np.linalg.norm(matrix(detections[0].pose)[:3, 3] - truth[:3, 3]) < 0.0015


def test_tags_of_nothing_and_of_little_contrast_are_left_out() -> None:
    seen = seen_from_above()
    assert [each.name for each in detector({"bin": TAGS["bin"]}).find("", [seen])] == ["bin"]
    assert not detector(TAGS, margin=255.0).find("", [seen])


def test_without_a_calibrated_camera_the_error_says_what_is_missing() -> None:
    with pytest.raises(SensorError, match=r"calibration \(`ibrobot camera calibrate`\) and a known place"):
        detector(TAGS).find("cube", [])


@pytest.mark.parametrize(
    ("tags", "why"),
    [
        ({}, "tags: name at least one object"),
        ({"a": Tag(id=1, size=0.1), "b": Tag(id=1, size=0.2)}, "several objects have tag 1"),
    ],
)
def test_wrong_tags_are_refused(tags: Mapping[str, Tag], why: str) -> None:
    with pytest.raises(ValueError, match=why):
        TagOptions(tags)

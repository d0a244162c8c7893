"""Attacks by pictures, calibrations, transforms, tags, detections and names; `hostile_pictures.py` makes more."""

from __future__ import annotations

from collections import Counter
from types import SimpleNamespace
from typing import Any

import attrs
import numpy as np
import pytest
from ibrobot_detect import finder
from ibrobot_detect.detector import Detection, Seen
from ibrobot_detect.finder import Finder
from ibrobot_detect.options import DetectOptions, Tag, TagOptions
from ibrobot_detect.tags import TagDetector
from ibrobot_kinematics.poses import pose_at
from ibrobot_testing import make_session

from ibrobot_core.api import Pose, Quaternion, SensorError, Vector3

from .hostile_pictures import attack, names
from .pictures import camera, facing, photograph


def test_what_is_hostile_gets_an_answer_or_an_error_with_the_reason() -> None:
    outcomes = Counter(attack(number) for number in range(300))
    assert outcomes["answered"] > 30
    assert outcomes["SensorError"] > 20


@pytest.mark.parametrize("size", [(1, 1), (2, 2), (500, 1), (500, 2), (2, 500), (15, 15)])
def test_pictures_that_are_too_small_for_a_tag_show_none(size: tuple[int, int]) -> None:
    """The library crashes on pictures of one or two rows, which an agent's camera, or a peer, may send."""
    width, height = size
    pixels = np.zeros((height, width, 3), np.uint8)
    sight = attrs.evolve(camera(np.eye(4)), size=size, pixels=pixels)
    detector = TagDetector(TagOptions({"cube": Tag(id=3, size=0.04)}), make_session())
    assert detector.find("", [sight]) == []


def test_a_tag_that_a_camera_sees_twice_is_refused_since_one_may_be_a_copy() -> None:
    """A copy, e.g. printed on a poster, or in a mirror, would get the pose of the original, or take its place."""
    sight = camera(np.eye(4))
    tags = {"cube": Tag(id=3, size=0.04), "bin": Tag(id=11, size=0.04)}
    left, right = (photograph(sight, {3: (facing(0.2, 0.1, 0.3, (x, 0.0, 0.5)), 0.04)}) for x in (-0.1, 0.1))
    assert left.pixels is not None
    assert right.pixels is not None
    middle = left.size[0] // 2
    both = attrs.evolve(sight, pixels=np.concatenate([left.pixels[:, :middle], right.pixels[:, middle:]], axis=1))
    detector = TagDetector(TagOptions(tags), make_session())
    assert [each.name for each in detector.find("", [left])] == ["cube"]
    twice = r"camera top sees tag 3 of 'cube' twice, at \d+, \d+ and \d+, \d+ px: remove or cover the one"
    for name in ("cube", ""):
        with pytest.raises(SensorError, match=twice):
            detector.find(name, [both])
    assert detector.find("bin", [both]) == []


def test_texts_choose_names_among_hostile_ones() -> None:
    assert sum(map(names, range(500))) > 0


PLACE = pose_at((0.1, 0.2, 0.3))
UNREADABLE = (
    "",
    " ",
    "cup\nkeys  Y lets it move",
    "\x1b[2J",
    "cu\u202ep",
    "cup\u200b",
    "cup\u3164",
    "\ud800",
    "c" * 101,
)
"""Names that people would read as another one, or not at all."""


@pytest.mark.parametrize(
    ("detections", "why"),
    [
        ([Detection("cup", Pose(Vector3(float("nan"), 0, 0), Quaternion()))], "'cup': its pose is not finite"),
        ([Detection("cup", Pose(Vector3(1e9, 0, 0), Quaternion()))], "'cup': its pose is not finite"),
        ([Detection("cup", Pose(Vector3(), Quaternion(0, 0, 0, 0)))], "'cup': its quaternion has length 0"),
        ([Detection("cup", PLACE, score=float("nan"))], "'cup': its score is nan, must be 0 to 1"),
        ([Detection("cup", PLACE, score=2)], "'cup': its score is 2, must be 0 to 1"),
        ([Detection("cup", PLACE, (0.1, float("inf")))], "'cup': its size is not finite"),
        (
            [Detection("cup", PLACE, seen=(Seen("top", (0, 0, float("nan"), 1)),))],
            "'cup': its box in the picture of top",
        ),
        ([Detection("cup", None)], "'cup': "),  # type: ignore[arg-type]
        ([Detection(3, PLACE)], "its name is 3"),  # type: ignore[arg-type]
        *(([Detection(each, PLACE)], "a name is one line of 1 to 100 visible characters") for each in UNREADABLE),
        ([None], "its result has None"),
        (None, "its result is None"),
        ([Detection("cup", PLACE)] * 2_000, "2000 objects, at most 1000"),
    ],
)
def test_detector_that_breaks_its_promise_is_named_with_the_reason(
    monkeypatch: pytest.MonkeyPatch, detections: Any, why: str
) -> None:
    liar = SimpleNamespace(find=lambda name, sights: detections, close=lambda: None)
    described = SimpleNamespace(make=lambda options, run: liar, pictures=False)
    monkeypatch.setattr(finder, "options_of", lambda type_, plain: (described, None))
    made = Finder(DetectOptions(use={"liar": {}}), session := make_session())
    made.start()
    with pytest.raises(SensorError) as caught:
        session.bus.call("/find", None)
    made.stop()
    assert str(caught.value).startswith("detector liar: ")
    assert why in str(caught.value)


def test_detector_that_fails_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(name: str, sights: Any) -> Any:
        raise ZeroDivisionError("by zero")

    liar = SimpleNamespace(find=fail, close=lambda: None)
    described = SimpleNamespace(make=lambda options, run: liar, pictures=False)
    monkeypatch.setattr(finder, "options_of", lambda type_, plain: (described, None))
    made = Finder(DetectOptions(use={"liar": {}}), session := make_session())
    made.start()
    with pytest.raises(SensorError, match=r"detector liar: it failed: .*by zero"):
        session.bus.call("/find", None)
    made.stop()

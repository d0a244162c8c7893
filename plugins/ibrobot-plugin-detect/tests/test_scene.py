"""Objects of the world."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, cast, override

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ibrobot_detect.detector import Detector, Sight, fits
from ibrobot_detect.options import SceneOptions
from ibrobot_detect.scene import SceneDetector
from ibrobot_detect.suite import DetectorSuite
from ibrobot_kinematics.poses import homogeneous, pose_at
from ibrobot_kinematics.rotations import from_rpy
from ibrobot_testing import make_session, stand_in

from ibrobot_core.api import Context, PlanningError, Pose, SceneObject
from ibrobot_core.app import RunView

from .pictures import camera

ABOVE = homogeneous(from_rpy(np.pi, 0, 0), np.array([0.2, 0.0, 0.8]))
THINGS = (
    SceneObject("cube", "box", (0.03, 0.03, 0.03), pose_at((0.2, 0.1, 0.015), (0, 0, 0.4))),
    SceneObject("bottle", "cylinder", (0.03, 0.2), pose_at((0.25, -0.1, 0.1))),
    SceneObject("ball", "sphere", (0.02,), pose_at((0.1, 0.0, 0.02))),
)


def run_with(things: Sequence[SceneObject]) -> RunView:
    session = make_session()
    session.bus.serve(stand_in("/world/shapes"), lambda request: things)
    return cast("RunView", session)


class TestSceneDetector(DetectorSuite):
    pictures = False
    tolerance_m = tolerance_rad = 1e-6

    @override
    def make(self, ctx: Context) -> Detector:
        return SceneDetector(SceneOptions(), run_with(THINGS))

    @override
    def sights(self) -> Sequence[Sight]:
        return [camera(ABOVE)]

    @override
    def objects(self) -> Mapping[str, Pose]:
        return {each.name: each.pose for each in THINGS}


def test_what_is_outside_of_the_picture_is_found_but_not_seen() -> None:
    away = SceneObject("post", "capsule", (0.02, 0.5), pose_at((3.0, 0.0, 0.3)))
    detections = SceneDetector(SceneOptions(), run_with([*THINGS, away])).find("post", [camera(ABOVE)])
    assert [(each.name, each.seen) for each in detections] == [("post", ())]
    assert detections[0].size_m == pytest.approx((0.04, 0.04, 0.54))


def test_what_is_behind_the_camera_is_not_seen() -> None:
    behind = SceneObject("lamp", "box", (0.1, 0.1, 0.1), pose_at((0.2, 0.0, 1.2)))
    assert SceneDetector(SceneOptions(), run_with([behind])).find("", [camera(ABOVE)])[0].seen == ()


def test_without_a_world_the_error_says_what_to_add() -> None:
    with pytest.raises(PlanningError, match=r"needs the section `world`, e\.g\. `world: \{scene: true\}`"):
        SceneDetector(SceneOptions(), cast("RunView", make_session())).find("cube", [])


@pytest.mark.parametrize(
    ("text", "chosen"),
    [
        ("cube", ["cube"]), ("Red Cube", ["red_cube"]), ("the red cube", ["cube", "red_cube"]), ("cub", []),
        ("cubes", []), ("bin", ["bin"]), ("", ["cube", "red_cube", "bin"]), ("!!", ["cube", "red_cube", "bin"]),
    ],
)  # fmt: skip
def test_words_choose_names(text: str, chosen: list[str]) -> None:
    known = ["cube", "red_cube", "bin"]
    assert (fits(text, known) if text.strip("!") else known) == chosen


@given(st.text(max_size=50), st.lists(st.text(max_size=20), max_size=5))
def test_any_text_chooses_some_of_the_names(text: str, known: list[Any]) -> None:
    assert set(fits(text, known)) <= set(known)
    assert all(each in fits(each, known) for each in known)

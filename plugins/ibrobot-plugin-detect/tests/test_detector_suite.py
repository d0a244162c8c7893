"""The detector suite passes the fake, and each of its checks catches something wrong."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, override

import attrs
import numpy as np
import pytest
from ibrobot_detect.detector import Detection, Detector, Sight
from ibrobot_detect.fakes import FakeDetector
from ibrobot_detect.suite import DetectorSuite
from ibrobot_kinematics.poses import pose_at
from ibrobot_testing import checks, failed_checks

from ibrobot_core.api import Context, Pose


def table() -> Sight:
    """A camera 0.5 m above the table, which looks straight down; it sees a red and a blue thing."""
    pixels = np.full((120, 160, 3), 200, np.uint8)
    pixels[35:46, 95:106] = (220, 20, 20)
    pixels[75:86, 55:66] = (20, 20, 200)
    intrinsics = np.array([[200.0, 0, 80], [0, 200.0, 60], [0, 0, 1]])
    above = np.diag([1.0, -1.0, -1.0, 1.0])
    above[2, 3] = 0.5
    return Sight("top", 1, pixels, (160, 120), intrinsics, np.zeros(5), above)


class TestFake(DetectorSuite):
    kind: ClassVar[type[Detector]] = FakeDetector
    tolerance_rad = np.pi  # it knows no orientation

    @override
    def make(self, ctx: Context) -> Detector:
        return self.kind()

    @override
    def sights(self) -> Sequence[Sight]:
        return [table()]

    @override
    def objects(self) -> Mapping[str, Pose]:
        return {"red thing": pose_at((0.05, 0.05, 0.0)), "blue thing": pose_at((-0.05, -0.05, 0.0))}


class Changed(FakeDetector):
    """A detector of which each answer is changed."""

    def change(self, each: Detection) -> Detection:
        return each

    @override
    def find(self, name: str, sights: Sequence[Sight]) -> Sequence[Detection]:
        return [self.change(each) for each in super().find(name, sights)]


class Shifted(Changed):
    @override
    def change(self, each: Detection) -> Detection:
        there = attrs.evolve(each.pose.position, x=each.pose.position.x + 0.01)
        return attrs.evolve(each, pose=attrs.evolve(each.pose, position=there))


class FindsAll(FakeDetector):
    @override
    def find(self, name: str, sights: Sequence[Sight]) -> Sequence[Detection]:
        return super().find("", sights)


class LeastSureFirst(FakeDetector):
    @override
    def find(self, name: str, sights: Sequence[Sight]) -> Sequence[Detection]:
        return super().find(name, sights)[::-1]


class SeenByNobody(Changed):
    @override
    def change(self, each: Detection) -> Detection:
        return attrs.evolve(each, seen=())


class BoxElsewhere(Changed):
    @override
    def change(self, each: Detection) -> Detection:
        return attrs.evolve(each, seen=tuple(attrs.evolve(seen, box_px=(0.0, 0.0, 9.0, 9.0)) for seen in each.seen))


class SeesThingsInTheDark(FakeDetector):
    @override
    def find(self, name: str, sights: Sequence[Sight]) -> Sequence[Detection]:
        return super().find(name, sights) or super().find(name, [table()])


class PaintsThePicture(FakeDetector):
    @override
    def find(self, name: str, sights: Sequence[Sight]) -> Sequence[Detection]:
        for each in sights:
            assert each.pixels is not None
            each.pixels[0, 0] = 0
        return super().find(name, sights)


class ClosesOnce(FakeDetector):
    closed = False

    @override
    def close(self) -> None:
        assert not self.closed
        self.closed = True


WRONG: dict[type[Detector], str] = {
    Shifted: "finds_each_object_where_it_is",
    FindsAll: "a_name_chooses",
    LeastSureFirst: "the_surest_comes_first",
    SeenByNobody: "says_where_it_is_seen",
    BoxElsewhere: "says_where_it_is_seen",
    SeesThingsInTheDark: "empty_pictures_show_nothing",
    PaintsThePicture: "changes_no_picture",
    ClosesOnce: "close_is_safe_to_call_twice",
}


@pytest.mark.parametrize(("wrong", "caught_by"), WRONG.items(), ids=lambda v: getattr(v, "__name__", v))
def test_catches(wrong, caught_by, tmp_path):
    class Suite(TestFake):
        kind = wrong

    assert caught_by in failed_checks(Suite, tmp_path)


def test_every_check_catches_something():
    assert checks(DetectorSuite) == set(WRONG.values())

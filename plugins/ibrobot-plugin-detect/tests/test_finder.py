"""The service `/find` of a run."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from ibrobot_detect import finder
from ibrobot_detect.detector import Detection, Detector, Seen, Sight
from ibrobot_detect.finder import FIND, Finder, Found
from ibrobot_detect.options import DetectOptions, Find
from ibrobot_kinematics.poses import pose_at
from ibrobot_testing import make_robot, make_session

from ibrobot_core.api import CameraInfo, Header, IbrobotError, Image, Quaternion, TFMessage, TransformStamped, Vector3
from ibrobot_core.app import RequestError, Session

SIZE = (8, 6)
K = np.array([10.0, 0, 3.5, 0, 10.0, 2.5, 0, 0, 1])


class Looker(Detector):
    """Finds two things in each picture, one before the other."""

    def __init__(self, options: Any, run: Any) -> None:
        self.asked: list[tuple[str, Sequence[Sight]]] = []
        self.closed = 0

    def find(self, name: str, sights: Sequence[Sight]) -> Sequence[Detection]:
        self.asked.append((name, sights))
        boxes = {"wall": (0.0, 0.0, 7.0, 5.0), "cup": (2.0, 1.0, 4.0, 3.0)}
        return [
            Detection(each, pose_at((0.1, 0.2, 0.3)), score=0.5, seen=tuple(Seen(s.camera, box) for s in sights))
            for each, box in boxes.items()
            if name in ("", each)
        ]

    def close(self) -> None:
        self.closed += 1


class Rig:
    def __init__(self, monkeypatch: pytest.MonkeyPatch, pictures: bool = True) -> None:
        self.session: Session = make_session()
        self.looker = Looker(None, None)
        self.mounted: tuple[TransformStamped, ...] = ()
        described = SimpleNamespace(make=lambda options, run: self.looker, pictures=pictures)
        monkeypatch.setattr(finder, "options_of", lambda type_, plain: (described, None))
        self.finder = Finder(DetectOptions(use={"looker": {}}), cast("Any", self.session))
        self.finder.start()

    def camera(
        self, name: str, *, k: Any = K, placed: bool = True, size: tuple[int, int] = SIZE, model: str = "plumb_bob"
    ) -> None:
        bus, frame = self.session.bus, f"{name}_optical_frame"
        info = CameraInfo(Header(1, frame), size[1], size[0], model, d=np.zeros(5), k=k, r=np.eye(3), p=np.zeros(12))
        bus.publish(f"/camera/{name}/camera_info", info, latched=True)
        bus.publish(f"/camera/{name}/image_raw", _image(frame))
        if placed:
            mounted = TransformStamped(Header(1, "base"), frame, Vector3(0.0, 0.0, 1.0), Quaternion())
            self.mounted = (*self.mounted, mounted)
            bus.publish("/tf_static", TFMessage(self.mounted), latched=True)


def _image(frame: str) -> Image:
    width, height = SIZE
    return Image(Header(1, frame), height, width, "rgb8", 3 * width, np.zeros(3 * width * height, np.uint8))


@pytest.fixture
def rig(monkeypatch: pytest.MonkeyPatch) -> Iterator[Rig]:
    def taken(session: Session, topics: Any, timeout_s: float) -> dict[str, Image]:
        return {name: _image(f"{name}_optical_frame") for name in topics}

    monkeypatch.setattr(finder, "next_pictures", taken)
    made = Rig(monkeypatch)
    yield made
    made.finder.stop()
    assert made.looker.closed == 1
    assert not made.session.bus.serves(FIND)


def test_objects_come_with_poses_and_places_in_pictures(rig: Rig) -> None:
    rig.camera("top")
    answer: Found = rig.session.bus.call("/find", "cup")
    assert [(each.name, each.detector, each.position_m, each.score) for each in answer.objects] == [
        ("cup", "looker", (0.1, 0.2, 0.3), 0.5)
    ]
    assert answer.objects[0].seen == (Seen("top", (2.0, 1.0, 4.0, 3.0)),)
    ((name, sights),) = rig.looker.asked
    assert (name, sights[0].camera, sights[0].size) == ("cup", "top", SIZE)
    assert sights[0].pose[:3, 3].tolist() == [0.0, 0.0, 1.0]
    assert sights[0].pixels is not None


@pytest.mark.parametrize(
    ("at", "names"), [((3, 2), ["cup", "wall"]), ((0.5, 0.5), ["wall"]), ((9, 9), [])], ids=["both", "one", "none"]
)
def test_a_place_in_a_picture_chooses_what_is_seen_there(rig: Rig, at: tuple[float, float], names: list[str]) -> None:
    rig.camera("top")
    answer: Found = rig.session.bus.call("/find", {"camera": "top", "at": list(at)})
    assert [each.name for each in answer.objects] == names


@pytest.mark.parametrize(
    ("camera", "why"),
    [
        ({"k": np.zeros(9)}, "it has no calibration; `ibrobot camera calibrate` makes one"),
        ({"k": np.full(9, np.nan)}, "its calibration has no finite focal lengths"),
        ({"k": -K}, "its calibration has no finite focal lengths"),
        ({"model": "equidistant"}, "distortion model equidistant is not supported; plumb_bob is"),
        ({"placed": False}, "no transform of frame 'side_optical_frame' to the base; peripherals[].transform says"),
        ({"size": (20, 10)}, "its pictures have 8 x 6 pixels, its calibration is for 20 x 10"),
    ],
)  # fmt: skip
def test_cameras_that_cannot_be_used_are_named_with_the_reason(rig: Rig, camera: Any, why: str) -> None:
    rig.camera("top")
    rig.camera("side", **camera)
    answer: Found = rig.session.bus.call("/find", None)
    assert list(answer.without) == ["side"]
    assert answer.without["side"].startswith(why)
    assert [each.camera for each in rig.looker.asked[0][1]] == ["top"]
    with pytest.raises(Exception, match="camera side: "):
        rig.session.bus.call("/find", {"camera": "side"})


@pytest.mark.parametrize(
    ("request_", "why"),
    [
        ({"camera": "left"}, "no camera 'left' sends pictures; these do: top"),
        ({"at": [1, 2]}, "at: name the camera, too"),
        ({"at": [1, 2, 3], "camera": "top"}, "at: give x and y, got 3 numbers"),
        ({"nmae": "cup"}, "nmae: unknown key, did you mean 'name'"),
        ({"timeout": 0}, "timeout: 0.0 is too small"),
        ({"name": 3}, "name: expected text, got 3"),
    ],
)
def test_wrong_requests_say_what_would_be_right(rig: Rig, request_: Any, why: str) -> None:
    rig.camera("top")
    with pytest.raises(IbrobotError) as caught:
        rig.session.bus.call("/find", request_)
    assert why in str(caught.value)


def test_detectors_without_pictures_take_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(finder, "next_pictures", lambda *arguments: pytest.fail("a picture was taken"))
    rig = Rig(monkeypatch, pictures=False)
    rig.camera("top")
    rig.session.bus.call(FIND, Find())
    assert [each.pixels for each in rig.looker.asked[0][1]] == [None]
    rig.finder.stop()


def test_detector_that_raises_at_the_end_keeps_no_other_open(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig(monkeypatch)
    closed: list[str] = []

    def detector(name: str, error: Exception | None) -> Any:
        def close() -> None:
            closed.append(name)
            if error is not None:
                raise error

        return SimpleNamespace(close=close)

    given = {"a": None, "b": RuntimeError("stuck"), "c": None}
    rig.finder._detectors = {name: (detector(name, error), False) for name, error in given.items()}
    with pytest.raises(RuntimeError, match="stuck"):
        rig.finder.stop()
    assert sorted(closed) == ["a", "b", "c"]


def test_options_of_detectors_are_checked_with_the_robot_yaml() -> None:
    assert not list(DetectOptions().check(make_robot(), ()))
    wrong = DetectOptions(use={"apriltag": {"tags": {"cube": {"id": -1, "size": 0.03}}}, "scene": {"size": 3}})
    faults = {each.option[1]: each.message for each in wrong.check(make_robot(), ())}
    assert "tags.cube.id: -1 is too small" in faults["apriltag"]
    assert "size: unknown key" in faults["scene"]
    missing = DetectOptions(use={"owl": {}})
    assert "owl" in next(iter(missing.check(make_robot(), ()))).message


def test_find_is_for_everybody() -> None:
    assert FIND.reads
    assert not FIND.persons
    with pytest.raises(RequestError):
        FIND.read({"name": "x" * 2000})

"""Sensor `lerobot` with a fake LeRobot in a real device process: the suite of sensors, and its errors."""

from __future__ import annotations

import itertools
import time
from pathlib import Path
from typing import Any, override

import numpy as np
import pytest
from ibrobot_lerobot_devices.camera import LeRobotCamera
from ibrobot_lerobot_devices.device import Pictures
from ibrobot_lerobot_devices.options import CameraOptions
from ibrobot_ros2.jpeg import from_jpeg
from ibrobot_testing.contexts import host_context
from ibrobot_testing.sensor import SensorSuite

from ibrobot_core.api import CompressedImage, Context, Image, Message, RealClock, Sensor, SensorError


def options(path: Path, **changes: Any) -> CameraOptions:
    config = changes.pop("config", {})
    return CameraOptions("fake_still", {"path": str(path), **config}, **changes)


def first(path: Path, **changes: Any) -> Message:
    """The first picture of a camera, which is 7, 20, 30 as the camera orders its colours."""
    path.write_text(f"7 {time.perf_counter()}")
    camera = LeRobotCamera(options(path, **changes), host_context("top", clock=RealClock()))
    camera.open()
    try:
        return next(found for found in iter(lambda: camera.read(1.0), 0) if found is not None)
    finally:
        camera.close()


class TestLeRobotCamera(SensorSuite):
    @pytest.fixture(autouse=True)
    def _camera(self, tmp_path: Path) -> None:
        self.path = tmp_path / "camera"
        self.path.write_text("")
        self.count = itertools.count(1)

    @override
    def context(self) -> Context:
        return host_context("top", clock=RealClock())

    @override
    def make(self, ctx: Context) -> Sensor:
        return LeRobotCamera(options(self.path, encoding="raw"), ctx)

    @override
    def trigger(self, sensor: Sensor, ctx: Context) -> None:
        super().trigger(sensor, ctx)
        partial = self.path.with_suffix(".new")
        partial.write_text(f"{next(self.count)} {time.perf_counter()}")
        partial.rename(self.path)


def test_pixels_are_those_of_lerobot(tmp_path: Path) -> None:
    image = first(tmp_path / "camera", encoding="raw")
    assert isinstance(image, Image)
    assert (image.encoding, image.height, image.width) == ("rgb8", 24, 32)
    assert image.data.reshape(24, 32, 3)[3, 4].tolist() == [7, 20, 30]


@pytest.mark.parametrize(
    ("config", "encoding"),
    [
        ({"color_mode": "bgr"}, "bgr8"),
        ({"color_mode": "BGR"}, "bgr8"),
        ({"color_mode": "BGR", "as_enum": True}, "bgr8"),
        ({"color_mode": "RGB", "as_enum": True}, "rgb8"),
        ({"color_mode": None}, "rgb8"),
        ({"channels": 1}, "mono8"),
        ({"channels": 1, "kind": "uint16"}, "16UC1"),
    ],
)
def test_an_encoding_is_that_of_what_lerobot_gives(tmp_path: Path, config: dict[str, Any], encoding: str) -> None:
    image = first(tmp_path / "camera", encoding="raw", config=config)
    assert isinstance(image, Image)
    assert image.encoding == encoding


def test_a_jpeg_of_bgr_has_the_colours_of_the_picture(tmp_path: Path) -> None:
    jpeg = first(tmp_path / "camera", config={"color_mode": "BGR"})
    assert isinstance(jpeg, CompressedImage)
    blue, green, red = from_jpeg(jpeg).data.reshape(24, 32, 3)[3, 4].tolist()
    assert from_jpeg(jpeg).encoding == "bgr8"
    assert np.abs(np.subtract((blue, green, red), (7, 20, 30))).max() <= 3


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"color_mode": "yuv"}, "color_mode 'yuv'; ibrobot takes rgb and bgr"),
        ({"channels": 4}, r"shape \[24, 32, 4\] and type uint8"),
        ({"kind": "float32"}, r"shape \[24, 32, 3\] and type float32"),
        ({"channels": 1, "kind": "uint16"}, "depth, which cannot be a JPEG; use encoding: raw"),
    ],
)
def test_pictures_that_no_message_holds_are_refused(tmp_path: Path, config: dict[str, Any], message: str) -> None:
    with pytest.raises(SensorError, match=message):
        first(tmp_path / "camera", lost_after=0.001, config=config)


def test_a_camera_that_does_not_wait_gives_each_picture_once(tmp_path: Path) -> None:
    path = tmp_path / "camera"
    path.write_text(f"7 {time.perf_counter()}")
    camera = LeRobotCamera(options(path, config={"waits": False}), host_context("top", clock=RealClock()))
    camera.open()
    try:
        found = [camera.read(1.0) for _ in range(3)]
    finally:
        camera.close()
    assert [each is not None for each in found] == [True, False, False]


CAMERAS = list(
    itertools.product(
        ("none", "capture", "read"),  # what its time stamps say
        (None, 10.0, 30.0, 60.0),  # its fps
        (5.0, 10.0, 30.0, 60.0),  # how many pictures it takes a second
        (0.002, 0.007, 0.05),  # how often it is asked [s]
        (1, 3, 1000),  # how many pictures in a row are equal
    )
)


@pytest.mark.parametrize("stamps", ["none", "capture", "read"])
def test_no_picture_is_two_samples_and_none_of_another_look_is_lost(stamps: str) -> None:
    tried = 0
    for _, fps, takes, period_s, equal in (each for each in CAMERAS if each[0] == stamps):
        tried += 1
        seen, given, looks = Pictures(fps), [], set()
        for i in range(round(2 / period_s)):
            now_s = 1.0 + i * period_s
            number = int(now_s * takes + 1e-9)
            taken_s = {"none": None, "capture": number / takes, "read": now_s}[stamps]
            looks.add(number // equal)
            if seen.is_new(np.full((2, 3, 3), number // equal % 250, np.uint8), taken_s):
                given.append((number, taken_s))
        assert len({number // equal for number, _ in given}) == len(looks), (fps, takes, period_s, equal)
        if stamps == "capture":
            assert len({number for number, _ in given}) == len(given)
        elif stamps == "none":
            assert len(given) == len(looks)
        else:
            assert len(given) <= len(looks) + (0 if fps is None else 2 * fps / 0.9)
    assert tried == 144


def test_a_camera_that_cannot_be_opened_is_named(tmp_path: Path) -> None:
    camera = LeRobotCamera(options(tmp_path / "missing"), host_context("top"))
    with pytest.raises(SensorError, match="camera top: ConnectionError: no camera"):
        camera.open()
    camera.close()


def test_a_camera_that_is_lost_is_named(tmp_path: Path) -> None:
    path = tmp_path / "camera"
    path.write_text("")
    camera = LeRobotCamera(options(path, lost_after=0.001), host_context("top"))
    camera.open()
    try:
        path.unlink()
        with pytest.raises(SensorError, match="camera top: FileNotFoundError"):
            [camera.read(1.0) for _ in range(100)]
    finally:
        camera.close()

"""Processing of images of a V4L2 device; only OpenCV itself is replaced."""

from __future__ import annotations

import time
from typing import Any

import cv2
import numpy as np
import pytest
from ibrobot_camera import camera as camera_module
from ibrobot_camera import capture as capture_module
from ibrobot_camera.capture import Capture
from ibrobot_camera.device import Device
from ibrobot_camera.options import OpenCvOptions
from ibrobot_camera.v4l2 import Mode
from ibrobot_testing.contexts import host_context

from ibrobot_core.api import CompressedImage, RealClock, SensorError


class Scripted:
    """A fake `cv2.VideoCapture` of a V4L2 device that returns images from a list, with None for a damaged one."""

    def __init__(self, pictures: list[np.ndarray | None], formats: tuple[str, ...] = ()) -> None:
        self._pictures = pictures
        self._formats = formats
        self.properties = {cv2.CAP_PROP_FRAME_WIDTH: 4.0, cv2.CAP_PROP_FRAME_HEIGHT: 3.0}

    def get(self, prop: int) -> float:
        return self.properties.get(prop, 0.0)

    def set(self, prop: int, value: float) -> bool:
        if prop == cv2.CAP_PROP_FOURCC and int(value).to_bytes(4, "little").decode() not in self._formats:
            return False
        self.properties[prop] = value
        return True

    def grab(self) -> bool:
        return bool(self._pictures)

    def retrieve(self) -> tuple[bool, np.ndarray | None]:
        picture = self._pictures.pop(0)
        return picture is not None, picture

    def release(self) -> None:
        pass


class TestPictures:
    @staticmethod
    def capture(monkeypatch: pytest.MonkeyPatch, pictures: list[np.ndarray | None], **options: Any) -> Capture:
        monkeypatch.setattr(capture_module.Capture, "_open", lambda self: Scripted(pictures))
        return Capture(Device("v4l2", "/dev/video7"), OpenCvOptions(device=7, strict=False, **options), "top")

    def test_a_damaged_one_is_left_out(self, monkeypatch: pytest.MonkeyPatch) -> None:
        whole = np.zeros((3, 4, 3), np.uint8)
        source = self.capture(monkeypatch, [None, None, whole])
        assert source.read() is not None
        assert source.read() is None

    def test_source_with_only_damaged_images_is_lost(self, monkeypatch: pytest.MonkeyPatch) -> None:
        pictures: list[np.ndarray | None] = [None] * 100
        assert self.capture(monkeypatch, pictures).read() is None
        assert pictures

    @pytest.mark.parametrize(("age_ms", "is_stamp"), [(100.0, True), (None, False), (-1000.0, False), (2000.0, False)])
    def test_plausible_stamps_of_the_driver_are_kept(
        self, monkeypatch: pytest.MonkeyPatch, age_ms: float | None, is_stamp: bool
    ) -> None:
        source = self.capture(monkeypatch, [np.zeros((3, 4, 3), np.uint8)])
        begun_ns = time.monotonic_ns()
        stamp_ms = 0.0 if age_ms is None else begun_ns / 1e6 - age_ms
        source._capture.set(cv2.CAP_PROP_POS_MSEC, stamp_ms)
        picture = source.read()
        assert picture is not None
        assert (picture.taken_ns == round(stamp_ms * 1e6)) == is_stamp == (not source.lacks_stamps)
        assert is_stamp or begun_ns <= picture.taken_ns <= time.monotonic_ns()

    def test_a_driver_without_stamps_is_reported_once(
        self, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
    ) -> None:
        devices = [Scripted([np.zeros((3, 4, 3), np.uint8)] * 3)]

        def open_once(self: Capture) -> Scripted:
            if not devices:
                raise SensorError("unplugged")
            return devices.pop()

        monkeypatch.setattr(capture_module.Capture, "_open", open_once)
        monkeypatch.setattr(camera_module, "find_device", lambda device: Device("v4l2", "/dev/video7"))
        options = OpenCvOptions(device=7, strict=False, reconnect_timeout=0.0)
        camera = camera_module.OpenCvCamera(options, host_context("top", clock=RealClock()))
        camera.open()

        def read_on() -> None:
            while True:
                camera.read(10.0)

        with pytest.raises(SensorError, match="did not return"):
            read_on()
        camera.close()
        assert caplog.text.count("camera top: its driver gives no time stamps") == 1

    def test_z16_bytes_become_depths(self, monkeypatch: pytest.MonkeyPatch) -> None:
        depth = np.arange(12, dtype=np.uint16).reshape(3, 4)
        raw = depth.view(np.uint8).reshape(1, -1)
        picture = self.capture(monkeypatch, [raw[:, :10], raw], fourcc="Z16 ").read()
        assert picture is not None
        np.testing.assert_array_equal(picture.content, depth)


MJPG = float(cv2.VideoWriter.fourcc(*"MJPG"))


def jpeg(value: int) -> np.ndarray:
    """A grey 4x3 image as undecoded MJPG from OpenCV: bytes in one row."""
    _, file = cv2.imencode(".jpg", np.full((3, 4, 3), value, np.uint8))
    return np.asarray(file).reshape(1, -1)


class TestMotionJpeg:
    """A V4L2 device that offers some formats."""

    @pytest.fixture(autouse=True)
    def _device(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.patch = monkeypatch

    def open(
        self,
        pictures: list[np.ndarray | None],
        formats: tuple[str, ...],
        sizes: Any = ((4, 3),),
        mjpg_hz: float = 30.0,
        **options: Any,
    ) -> tuple[Capture, Scripted]:
        device = Scripted(pictures, formats)
        offered = tuple(
            Mode(each, width, height, (mjpg_hz if each == "MJPG" else 30.0,))
            for each, (width, height) in zip(formats, sizes, strict=True)
        )
        self.patch.setattr(capture_module.Capture, "_open", lambda self: device)
        self.patch.setattr(capture_module, "modes", lambda path: offered)
        return Capture(Device("v4l2", "/dev/video7"), OpenCvOptions(device=7, **options), "top"), device

    def test_it_is_asked_for_and_its_bytes_are_kept(self) -> None:
        capture, device = self.open([jpeg(80)], ("YUYV", "MJPG"), ((4, 3), (4, 3)), width=4, height=3)
        assert device.properties[cv2.CAP_PROP_FOURCC] == MJPG
        assert device.properties[cv2.CAP_PROP_CONVERT_RGB] == 0
        picture = capture.read()
        assert picture is not None
        assert isinstance(picture.content, CompressedImage)
        assert (picture.content.data.tobytes(), picture.size) == (jpeg(80).tobytes(), (3, 4))

    def test_a_damaged_one_is_left_out(self) -> None:
        whole = jpeg(80)
        capture, _ = self.open([whole[:, :-40], whole[:, :2], whole], ("MJPG",))
        picture = capture.read()
        assert picture is not None
        assert isinstance(picture.content, CompressedImage)
        assert picture.content.data.size == whole.size
        assert capture.read() is None

    def test_what_is_offered_at_another_rate_only_is_not_asked_for(self) -> None:
        _, device = self.open([], ("YUYV", "MJPG"), ((4, 3), (4, 3)), mjpg_hz=15.0, fps=30.0, width=4, height=3)
        assert cv2.CAP_PROP_FOURCC not in device.properties

    def test_what_is_offered_in_another_size_only_is_not_asked_for(self) -> None:
        pixels = np.zeros((3, 4, 3), np.uint8)
        capture, device = self.open([pixels], ("YUYV", "MJPG"), ((4, 3), (8, 6)), width=4, height=3)
        assert cv2.CAP_PROP_FOURCC not in device.properties
        assert not capture.own_jpeg
        picture = capture.read()
        assert picture is not None
        assert isinstance(picture.content, np.ndarray)

    def test_another_format_may_be_asked_for(self) -> None:
        capture, device = self.open([], ("YUYV", "MJPG"), ((4, 3), (4, 3)), fourcc="YUYV")
        assert device.properties[cv2.CAP_PROP_FOURCC] == cv2.VideoWriter.fourcc(*"YUYV")
        assert not capture.own_jpeg

    @pytest.mark.parametrize("options", [{"encoding": "raw"}, {"rotation": 90}])
    def test_it_saves_the_bus_also_where_its_bytes_cannot_be_kept(self, options: dict[str, Any]) -> None:
        capture, device = self.open([np.zeros((3, 4, 3), np.uint8)], ("MJPG",), **options)
        assert device.properties[cv2.CAP_PROP_FOURCC] == MJPG
        assert cv2.CAP_PROP_CONVERT_RGB not in device.properties
        assert not capture.own_jpeg

"""What is made of OpenCV's pictures of a V4L2 device, where only OpenCV itself is replaced."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from ibrobot_camera import capture as capture_module
from ibrobot_camera.capture import Capture
from ibrobot_camera.device import Device
from ibrobot_camera.options import OpenCvOptions


class Scripted:
    """What OpenCV gives for a V4L2 device, from a list: the bytes of a picture, or None for one that is damaged."""

    def __init__(self, pictures: list[np.ndarray | None]) -> None:
        self._pictures = pictures

    def get(self, prop: int) -> float:
        return {cv2.CAP_PROP_FRAME_WIDTH: 4.0, cv2.CAP_PROP_FRAME_HEIGHT: 3.0}.get(prop, 0.0)

    def set(self, prop: int, value: float) -> bool:
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

    def test_none_but_damaged_ones_are_a_lost_source(self, monkeypatch: pytest.MonkeyPatch) -> None:
        pictures: list[np.ndarray | None] = [None] * 100
        assert self.capture(monkeypatch, pictures).read() is None
        assert pictures

    def test_z16_bytes_become_depths(self, monkeypatch: pytest.MonkeyPatch) -> None:
        depth = np.arange(12, dtype=np.uint16).reshape(3, 4)
        raw = depth.view(np.uint8).reshape(1, -1)
        picture = self.capture(monkeypatch, [raw[:, :10], raw], fourcc="Z16 ").read()
        assert picture is not None
        np.testing.assert_array_equal(picture.pixels, depth)

"""Sensor `lerobot` with a fake LeRobot in a real device process: the suite of sensors, and its errors."""

from __future__ import annotations

import itertools
import time
from pathlib import Path
from typing import Any, override

import pytest
from ibrobot_lerobot_devices.camera import LeRobotCamera
from ibrobot_lerobot_devices.options import CameraOptions
from ibrobot_testing.contexts import host_context
from ibrobot_testing.sensor import SensorSuite

from ibrobot_core.api import Context, Image, RealClock, Sensor, SensorError


def options(path: Path, **changes: Any) -> CameraOptions:
    return CameraOptions("fake_still", {"path": str(path)}, **changes)


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
    (tmp_path / "camera").write_text(f"7 {time.perf_counter()}")
    camera = LeRobotCamera(options(tmp_path / "camera", encoding="raw"), host_context("top", clock=RealClock()))
    camera.open()
    try:
        image = next(found for found in iter(lambda: camera.read(1.0), 0) if found is not None)
    finally:
        camera.close()
    assert isinstance(image, Image)
    assert (image.encoding, image.height, image.width) == ("rgb8", 24, 32)
    assert image.data.reshape(24, 32, 3)[3, 4].tolist() == [7, 20, 30]


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

"""The sensor `realsense` on the library's own software device: real frames through the real library."""

from __future__ import annotations

import json
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any, override

import attrs
import numpy as np
import pytest
from ibrobot_camera import realsense
from ibrobot_camera.librealsense import load_library
from ibrobot_camera.options import RealSenseOptions
from ibrobot_camera.realsense import RealSenseCamera
from ibrobot_ros2.jpeg import from_jpeg
from ibrobot_testing import SensorSuite, host_context

from ibrobot_core.api import (
    CameraInfo,
    CompressedImage,
    Context,
    Image,
    MissingDependency,
    RealClock,
    Sensor,
    SensorError,
)
from ibrobot_core.app import installed_plugins

WIDTH, HEIGHT = 64, 48
PATIENCE_S = 30.0
SMALL = RealSenseOptions(width=WIDTH, height=HEIGHT)


@pytest.mark.parametrize(
    ("reason", "message"),
    [
        (
            "ModuleNotFoundError(\"No module named 'pyrealsense2'\")",
            'the Python package pyrealsense2 is not installed; pip install "ibrobot-plugin-camera[realsense]"',
        ),
        (
            "ImportError('libusb-1.0.so.0: cannot open shared object file')",
            "pyrealsense2 cannot be loaded: libusb-1.0.so.0: cannot open shared object file; "
            "sudo apt-get install libusb-1.0-0",
        ),
        (
            "ImportError('libother.so.1: cannot open shared object file')",
            "pyrealsense2 cannot be loaded: libother.so.1: cannot open shared object file; "
            "install the system package that contains libother.so.1",
        ),
    ],
)
def test_what_the_library_lacks_is_named_with_its_remedy(
    reason: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "pyrealsense2.py").write_text(f"raise {reason}")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "pyrealsense2", raising=False)
    with pytest.raises(MissingDependency) as missing:
        RealSenseCamera(SMALL, host_context("top"))
    assert str(missing.value) == message
    assert str(installed_plugins().missing("sensor", "realsense")) == message


class SoftwareCamera:
    """A RealSense in software, whose colour and depth encode the image number."""

    def __init__(self, rs: Any, unit: float = 0.001) -> None:
        self._rs = rs
        self._unit = unit
        self.device = rs.software_device()
        self.device.register_info(rs.camera_info.serial_number, "1")
        self._streams = {}
        intrinsics = rs.intrinsics()
        intrinsics.width, intrinsics.height, intrinsics.fx, intrinsics.fy = WIDTH, HEIGHT, 50.0, 50.0
        intrinsics.ppx, intrinsics.ppy, intrinsics.model, intrinsics.coeffs = 32.0, 24.0, rs.distortion.none, [0.0] * 5
        kinds = (("depth", rs.stream.depth, rs.format.z16, 2), ("color", rs.stream.color, rs.format.bgr8, 3))
        for uid, (name, stream, pixel_format, size) in enumerate(kinds):
            sensor = self.device.add_sensor(name)
            video = rs.video_stream()
            video.type, video.uid, video.index, video.fmt, video.bpp = stream, uid, 0, pixel_format, size
            video.width, video.height, video.fps, video.intrinsics = WIDTH, HEIGHT, 30, intrinsics
            if name == "depth":
                sensor.add_read_only_option(rs.option.depth_units, unit)
            self._streams[name] = sensor, sensor.add_video_stream(video), size
        same_place = rs.extrinsics()
        same_place.rotation, same_place.translation = [1, 0, 0, 0, 1, 0, 0, 0, 1], [0, 0, 0]
        self._streams["depth"][1].register_extrinsics_to(self._streams["color"][1], same_place)
        self.device.create_matcher(rs.matchers.default)
        self.number = 0
        self.running = threading.Event()
        self.ended = threading.Event()
        self.thread = threading.Thread(target=self._run)

    def _run(self) -> None:
        while not self.ended.wait(0.02):
            if self.running.is_set():
                self.number += 1
                self._push("depth", np.full((HEIGHT, WIDTH), 1000 + self.number, dtype=np.uint16))
                self._push("color", np.full((HEIGHT, WIDTH, 3), self.number % 200, dtype=np.uint8))

    def _push(self, name: str, pixels: np.ndarray) -> None:
        sensor, profile, size = self._streams[name]
        frame = self._rs.software_video_frame()
        frame.pixels, frame.stride, frame.bpp = pixels, WIDTH * size, size
        frame.timestamp, frame.domain = self.number * 20.0, self._rs.timestamp_domain.hardware_clock
        frame.frame_number, frame.profile = self.number, profile.as_video_stream_profile()
        if name == "depth":
            frame.depth_units = self._unit
        sensor.on_video_frame(frame)


@pytest.fixture(autouse=True)
def patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a busy machine the software device, a thread of this process, may be silent for a while."""
    monkeypatch.setattr(realsense, "_LOST_S", PATIENCE_S)


@pytest.fixture(scope="module")
def library() -> Iterator[Any]:
    """Intel's library; tests with it are skipped where it, or a system library that it needs, is missing."""
    try:
        library = load_library()
    except MissingDependency as missing:
        pytest.skip(str(missing))
    # While there is a context, libusb keeps the socket by which it hears of devices: no test opens it.
    context = library.context()
    context.query_devices()
    yield library
    del context


@pytest.fixture(params=[0.001])
def soft(library: Any, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[SoftwareCamera]:
    camera = SoftwareCamera(library, request.param)
    monkeypatch.setattr(realsense, "find_device", lambda serial: camera.device)
    camera.running.set()
    camera.thread.start()
    yield camera
    camera.ended.set()
    camera.thread.join()


class TestConformance(SensorSuite):
    timeout_s = PATIENCE_S

    @pytest.fixture(autouse=True)
    def _soft(self, soft: SoftwareCamera) -> None:
        self.soft = soft

    @override
    def context(self) -> Context:
        return host_context("top", clock=RealClock())

    @override
    def make(self, ctx: Context) -> Sensor:
        return RealSenseCamera(SMALL, ctx)

    @override
    def silence(self, sensor: Sensor) -> None:
        self.soft.running.clear()
        while sensor.read(0.1) is not None:
            pass


def test_colour_and_aligned_depth_share_a_camera(soft: SoftwareCamera) -> None:
    colour = RealSenseCamera(SMALL, host_context("top", clock=RealClock()))
    depth = RealSenseCamera(RealSenseOptions(width=WIDTH, height=HEIGHT, stream="depth"), host_context("top_depth"))
    colour.open()
    depth.open()
    pictures = [sensor.read(PATIENCE_S) for sensor in (colour, depth)]
    ((_, info),) = colour.latched()
    colour.close()
    assert depth.read(PATIENCE_S) is not None, "the other goes on"
    depth.close()
    assert all(picture is not None for picture in pictures)
    assert isinstance(pictures[0], CompressedImage)
    assert from_jpeg(pictures[0]).encoding == "bgr8"
    assert isinstance(pictures[1], Image)
    assert pictures[1].encoding == "16UC1"
    distance = pictures[1].data.view(np.uint16).reshape(HEIGHT, WIDTH)[HEIGHT // 2, WIDTH // 2]
    assert 1000 < distance <= 1000 + soft.number
    assert isinstance(info, CameraInfo)
    assert (info.k[0], info.p[3], info.p[11]) == (50.0, 0.0, 0.0)


@pytest.mark.usefixtures("soft")
def test_a_calibration_file_replaces_what_the_camera_stores(tmp_path: Path) -> None:
    options = attrs.evolve(SMALL, info=calibration(tmp_path / "top.yaml", WIDTH))
    top = RealSenseCamera(options, host_context("top", clock=RealClock()))
    top.open()
    ((topic, info),) = top.latched()
    top.close()
    assert isinstance(info, CameraInfo)
    assert (topic, info.k[0], info.d[0]) == ("/camera/top/camera_info", 55.0, -0.1)
    assert options.lens["d"][0] == -0.1
    wrong = attrs.evolve(SMALL, info=calibration(tmp_path / "wide.yaml", 640))
    with pytest.raises(SensorError, match=r"camera top: .*wide\.yaml: is for images of 640x48, these are 64x48"):
        RealSenseCamera(wrong, host_context("top")).open()


def calibration(path: Path, width: int) -> Path:
    numbers = {
        "camera_matrix": [55.0, 0.0, 32.0, 0.0, 55.0, 24.0, 0.0, 0.0, 1.0], "distortion_coefficients": [-0.1] * 5,
        "rectification_matrix": np.eye(3).ravel().tolist(),
        "projection_matrix": [55.0, 0.0, 32.0, 0.0, 0.0, 55.0, 24.0, 0.0, 0.0, 0.0, 1.0, 0.0],
    }  # fmt: skip
    document = {"image_width": width, "image_height": HEIGHT, "distortion_model": "plumb_bob"}
    path.write_text(json.dumps({**document, **{name: {"data": data} for name, data in numbers.items()}}))
    return path


@pytest.mark.parametrize("soft", [0.0001], indirect=True)
def test_depth_is_in_millimetres_whatever_the_devices_unit(soft: SoftwareCamera) -> None:
    depth = RealSenseCamera(RealSenseOptions(width=WIDTH, height=HEIGHT, stream="depth"), host_context("depth"))
    depth.open()
    picture = depth.read(PATIENCE_S)
    depth.close()
    assert picture is not None
    distance = picture.data.view(np.uint16).reshape(HEIGHT, WIDTH)[HEIGHT // 2, WIDTH // 2]
    assert 100 <= distance <= (1000 + soft.number) / 10 + 1


def test_a_camera_that_falls_silent_for_long_is_lost(soft: SoftwareCamera, monkeypatch: pytest.MonkeyPatch) -> None:
    top = RealSenseCamera(SMALL, host_context("top", clock=RealClock()))
    top.open()
    assert top.read(PATIENCE_S) is not None
    soft.running.clear()
    monkeypatch.setattr(realsense, "_LOST_S", 0.3)
    with pytest.raises(SensorError, match=r"camera top: no images from the RealSense for 0\.3 s"):  # noqa: PT012
        while True:
            top.read(1.0)
    top.close()


def test_sizes_that_it_does_not_give_or_that_differ_are_refused(soft: SoftwareCamera) -> None:
    with pytest.raises(SensorError, match=r"does not offer color and depth of 640x480 at 30 Hz"):
        RealSenseCamera(RealSenseOptions(), host_context("top")).open()
    first = RealSenseCamera(SMALL, host_context("top"))
    first.open()
    with pytest.raises(SensorError, match=r"another peripheral has this RealSense open with 64x48 at 30 Hz"):
        RealSenseCamera(RealSenseOptions(), host_context("wrist")).open()
    first.close()


def test_no_device_says_which_there_are(library: Any) -> None:
    with pytest.raises(SensorError, match=r"no RealSense with serial number 42; available: none"):
        realsense.find_device("42")
    with pytest.raises(SensorError, match=r"set serial to select a RealSense; available: none"):
        realsense.find_device("")

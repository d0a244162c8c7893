"""The sensor `opencv` with real decoders: video files, a local stream, and lost sources that return."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, override

import cv2
import numpy as np
import pytest
from ibrobot_camera import capture as capture_module
from ibrobot_camera import device as device_module
from ibrobot_camera.camera import OpenCvCamera, to_image
from ibrobot_camera.capture import Capture
from ibrobot_camera.commands.sources import decoded
from ibrobot_camera.device import Device, find_device
from ibrobot_camera.options import OpenCvOptions
from ibrobot_testing import SensorSuite, host_context
from ibrobot_testing.contexts import START_NS
from stream_server import HEIGHT, WIDTH, StreamServer, number_of, numbered

from ibrobot_core.api import (
    CameraInfo,
    CompressedImage,
    Context,
    Header,
    Image,
    MissingDependency,
    RealClock,
    Sensor,
    SensorError,
    SteppedClock,
)

FRAMES, FPS = 12, 25.0
PATIENCE_S = 30.0


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twelve numbered images at 25 Hz."""
    path = tmp_path_factory.mktemp("video") / "numbers.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), FPS, (WIDTH, HEIGHT))
    for number in range(1, FRAMES + 1):
        writer.write(numbered(number))
    writer.release()
    return path


def camera(ctx: Context, device: Any, **options: Any) -> OpenCvCamera:
    return OpenCvCamera(OpenCvOptions(device=device, **options), ctx)


def number(message: Any) -> int:
    image = decoded(message)
    return number_of(image.data.reshape(image.height, image.width, 3))


class TestFileConformance(SensorSuite):
    @pytest.fixture(autouse=True)
    def _video(self, video: Path) -> None:
        self.video = video

    @override
    def context(self) -> Context:
        return host_context("top", clock=SteppedClock(START_NS))

    @override
    def make(self, ctx: Context) -> Sensor:
        return camera(ctx, str(self.video))

    @override
    def trigger(self, sensor: Sensor, ctx: Context) -> None:
        ctx.clock.sleep_until(ctx.clock.now_ns() + 40_000_000)

    def test_silence_gives_none(self) -> None:
        """There is no image between two due times."""
        with self.opened() as (sensor, _):
            assert sensor.read(0.0) is not None
            assert sensor.read(0.0) is None


class TestStreamConformance(SensorSuite):
    timeout_s = PATIENCE_S

    @pytest.fixture(autouse=True)
    def _server(self) -> Iterator[None]:
        with StreamServer() as self.server:
            yield

    @override
    def context(self) -> Context:
        return host_context("top", clock=RealClock())

    @override
    def make(self, ctx: Context) -> Sensor:
        return camera(ctx, self.server.url)

    @override
    def silence(self, sensor: Sensor) -> None:
        self.server.running.clear()
        while sensor.read(0.1) is not None:
            pass


class TestFile:
    def test_pictures_come_at_their_own_rate_in_the_clocks_time(self, video: Path) -> None:
        ctx = host_context("top", clock=SteppedClock(START_NS))
        top = camera(ctx, str(video))
        top.open()
        seen = []
        for _ in range(30):
            image = top.read(0.0)
            if image is not None:
                seen.append((number(image), image.header.stamp_ns - START_NS))
            ctx.clock.sleep_until(ctx.clock.now_ns() + 10_000_000)
        top.close()
        assert seen == [(n + 1, n * 40_000_000) for n in range(8)]

    def test_it_is_the_same_every_time(self, video: Path) -> None:
        runs = []
        for _ in range(2):
            ctx = host_context("top", clock=SteppedClock(START_NS))
            top = camera(ctx, str(video))
            top.open()
            images = [top.read(0.05) for _ in range(10)]
            runs.append([(i.header.stamp_ns, i.data.tobytes()) for i in images if i is not None])
            top.close()
        assert len(runs[0]) >= 9
        assert runs[0] == runs[1]

    def test_late_readers_get_the_newest_with_its_own_stamp(self, video: Path) -> None:
        ctx = host_context("top", clock=SteppedClock(START_NS))
        top = camera(ctx, str(video))
        top.open()
        ctx.clock.sleep_until(START_NS + 205_000_000)
        image = top.read(0.0)
        top.close()
        assert image is not None
        assert (number(image), image.header.stamp_ns) == (6, START_NS + 200_000_000)

    @pytest.mark.parametrize(("loop", "expected"), [(True, [12, 1, 2]), (False, [12])])
    def test_at_its_end_it_begins_again_or_falls_silent(self, video: Path, loop: bool, expected: list[int]) -> None:
        ctx = host_context("top", clock=SteppedClock(START_NS))
        top = camera(ctx, str(video), loop=loop)
        top.open()
        images = [top.read(0.05) for _ in range(14)]
        top.close()
        assert [number(image) for image in images[11:] if image is not None] == expected

    def test_its_own_jpegs_are_not_encoded_again(self, video: Path) -> None:
        raw, own = (self.first(video, encoding=encoding) for encoding in ("raw", "jpeg"))
        assert isinstance(raw, Image)
        assert isinstance(own, CompressedImage)
        assert video.read_bytes().count(own.data.tobytes()) == 1
        assert number(raw) == number(own) == 1

    def test_rotated_pictures_are_encoded_once(self, video: Path) -> None:
        message = self.first(video, rotation=180, jpeg_quality=95)
        assert isinstance(message, CompressedImage)
        assert message.format == "bgr8; jpeg compressed bgr8"
        assert number_of(np.rot90(decoded(message).data.reshape(HEIGHT, WIDTH, 3), 2)) == 1

    @staticmethod
    def first(video: Path, **options: Any) -> Image | CompressedImage:
        top = camera(host_context("top", clock=SteppedClock(START_NS)), str(video), **options)
        top.open()
        message = top.read(0.0)
        top.close()
        assert message is not None
        return message

    def test_rotation_turns_clockwise(self, video: Path) -> None:
        ctx = host_context("top", clock=SteppedClock(START_NS))
        top = camera(ctx, str(video), rotation=90)
        top.open()
        image = top.read(0.0)
        top.close()
        assert image is not None
        image = decoded(image)
        assert (image.height, image.width) == (WIDTH, HEIGHT)
        turned = np.rot90(image.data.reshape(WIDTH, HEIGHT, 3))
        assert number_of(turned) == 1

    def test_after_its_end_a_reader_waits(self, video: Path) -> None:
        ctx = host_context("top", clock=SteppedClock(START_NS))
        top = camera(ctx, str(video), loop=False)
        top.open()
        while ctx.clock.now_ns() < START_NS + 480_000_000:
            top.read(0.05)
        before = ctx.clock.now_ns()
        assert top.read(0.1) is None
        top.close()
        assert ctx.clock.now_ns() == before + 100_000_000


class TestStream:
    def test_its_jpegs_are_published_byte_by_byte(self) -> None:
        with StreamServer() as server:
            top = camera(host_context("top", clock=RealClock()), server.url)
            top.open()
            messages = [top.read(PATIENCE_S) for _ in range(5)]
            top.close()
            for message in messages:
                assert isinstance(message, CompressedImage)
                assert message.data.tobytes() == server.jpeg(number(message))

    def test_each_picture_is_new_and_as_old_as_it_says(self) -> None:
        with StreamServer() as server:
            ctx = host_context("top", clock=RealClock())
            top = camera(ctx, server.url)
            top.open()
            seen = [number(image) for _ in range(20) if (image := top.read(PATIENCE_S)) is not None]
            top.close()
        assert len(seen) == 20
        assert seen == sorted(set(seen))

    def test_a_reader_that_pauses_gets_the_newest(self) -> None:
        with StreamServer() as server:
            ctx = host_context("top", clock=RealClock())
            top = camera(ctx, server.url)
            top.open()
            top.read(PATIENCE_S)
            before = server.number
            while server.number < before + 100:
                time.sleep(0.01)
            image = top.read(PATIENCE_S)
            top.close()
            assert image is not None
            # A queue would return before + 1; on a busy machine the decoder may lag by a second.
            assert number(image) >= before + 50

    def test_a_lost_stream_comes_back(self, caplog: pytest.LogCaptureFixture) -> None:
        ctx = host_context("top", clock=RealClock())
        with StreamServer() as server:
            server.number = 10_000
            top = camera(ctx, server.url, reconnect_timeout=60.0)
            top.open()
            last = top.read(PATIENCE_S)
        assert last is not None
        while top.read(0.1) is not None:
            pass
        with StreamServer(server.port):
            image = None
            while image is None:
                image = top.read(PATIENCE_S)
            top.close()
        assert image.header.stamp_ns > last.header.stamp_ns
        assert number(image) < number(last), "a picture of the new stream"
        assert "camera top is lost; trying for 60 s" in caplog.text

    def test_a_stream_that_stays_away_is_an_error(self) -> None:
        ctx = host_context("top", clock=RealClock())
        with StreamServer() as server:
            top = camera(ctx, server.url, reconnect_timeout=0.0)
            top.open()
            assert top.read(PATIENCE_S) is not None
        with pytest.raises(SensorError, match=r"was lost and did not return within 0 s"):  # noqa: PT012
            while True:
                top.read(5.0)
        top.close()

    def test_no_server_is_reported_without_the_password(self) -> None:
        ctx = host_context("top", clock=RealClock())
        with pytest.raises(SensorError, match=r"camera top: rtsp://127\.0\.0\.1:9/live: cannot be opened") as caught:
            camera(ctx, "rtsp://arm:secret@127.0.0.1:9/live").open()
        assert "secret" not in str(caught.value)

    def test_nor_does_an_error_show_a_password_in_the_query(self) -> None:
        device = Device("stream", "http://host/video.mjpg?user=arm&password=secret")
        assert str(device) == "http://host/video.mjpg?…"

    def test_it_can_be_closed_after_it_did_not_open(self) -> None:
        top = camera(host_context("top", clock=RealClock()), "http://127.0.0.1:9/live")
        with pytest.raises(SensorError, match="cannot be opened"):
            top.open()
        top.close()
        with pytest.raises(SensorError, match="not open"):
            top.read(0.0)

    def test_it_cannot_be_in_lockstep(self) -> None:
        with pytest.raises(SensorError, match="a live source cannot run in lockstep; a video file can"):
            camera(host_context("top", clock=SteppedClock(START_NS)), "http://127.0.0.1:9/live").open()


class TestRequestedFormat:
    def test_the_rate_of_a_stream_is_its_senders(self) -> None:
        with StreamServer() as server:
            top = camera(host_context("top", clock=RealClock()), server.url, fps=30.0)
            top.open()
            top.close()

    def test_another_size_is_an_error_or_a_warning(self, video: Path) -> None:
        ctx = host_context("top", clock=SteppedClock(START_NS))
        with pytest.raises(SensorError, match=r"delivers 64x48 instead of 640x480; `strict: false` accepts it"):
            camera(ctx, str(video), width=640, height=480).open()
        with StreamServer() as server:
            real = host_context("top", clock=RealClock())
            top = camera(real, server.url, width=640, height=480, strict=False)
            top.open()
            top.close()

    def test_a_driver_that_does_not_take_a_control_is_reported(
        self, video: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(capture_module.Capture, "_open", lambda self: cv2.VideoCapture(str(video)))
        with pytest.raises(SensorError, match=r"camera top: /dev/video7: does not accept exposure: 40"):
            Capture(Device("v4l2", "/dev/video7"), OpenCvOptions(device=7, exposure=40.0, strict=False), "top")

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"width": 640}, "set both width and height"),
            ({"fourcc": "MJPEG"}, "four characters, e.g. MJPG, not 'MJPEG'"),
            ({"rotation": 45}, "45 is not one of: 0, 90, 180, 270"),
        ],
    )
    def test_options_that_cannot_be_are_refused(self, options: dict[str, Any], message: str) -> None:
        with pytest.raises(ValueError, match=message):
            OpenCvOptions(device=0, **options)


class TestDevices:
    @pytest.mark.parametrize(
        ("device", "kind", "target"),
        [
            (0, "v4l2", "/dev/video0"),
            ("2", "v4l2", "/dev/video2"),
            ("/dev/video4", "v4l2", "/dev/video4"),
            ("rtsp://host/live", "stream", "rtsp://host/live"),
        ],
    )
    def test_what_a_device_means(self, device: int | str, kind: str, target: str) -> None:
        assert find_device(device) == Device(kind, target)

    def test_missing_device_is_reported(self, video: Path, tmp_path: Path) -> None:
        with pytest.raises(SensorError, match=r"camera top: no file, URL or device 'usb-cam'"):
            camera(host_context("top", clock=RealClock()), "usb-cam").open()
        with pytest.raises(SensorError, match=r"/dev/video77: there is no such device; `ibrobot camera list`"):
            camera(host_context("top", clock=RealClock()), 77).open()
        (tmp_path / "no.mp4").write_text("no video")
        with pytest.raises(SensorError, match="is not a video that can be decoded"):
            camera(host_context("top"), str(tmp_path / "no.mp4")).open()
        (tmp_path / "vvc.avi").write_bytes(video.read_bytes().replace(b"MJPG", b"VVC1"))
        with pytest.raises(SensorError, match=r"vvc\.avi: OpenCV cannot decode its images \(video format vvc1\); use"):
            camera(host_context("top"), str(tmp_path / "vvc.avi")).open()

    def test_a_name_that_stays_is_found_by_device_or_by_usb_port(self, tmp_path, monkeypatch):
        """Equal cameras without serial numbers have one name by id, but each its own by its port."""
        for folder, name in (("by-id", "usb-HD_Cam"), ("by-path", "pci-usb-0:2")):
            (tmp_path / folder).mkdir()
            (tmp_path / folder / name).touch()
        monkeypatch.setattr(device_module, "BY_ID", tmp_path / "by-id")
        monkeypatch.setattr(device_module, "BY_PATH", tmp_path / "by-path")
        assert find_device("usb-HD_Cam") == Device("v4l2", str(tmp_path / "by-id" / "usb-HD_Cam"))
        assert find_device("pci-usb-0:2") == Device("v4l2", str(tmp_path / "by-path" / "pci-usb-0:2"))
        with pytest.raises(SensorError, match=r"by-id: usb-HD_Cam; devices under .*by-path: pci-usb-0:2"):
            find_device("pci-usb-0:9")

    @pytest.mark.parametrize(
        ("device", "message"),
        [
            ("usb-cam", "no file, URL or device 'usb-cam'"),
            (77, "/dev/video77: there is no such device; `ibrobot camera list` shows"),
        ],
    )
    def test_a_run_learns_beforehand_what_is_not_connected(self, device: int | str, message: str) -> None:
        with pytest.raises(MissingDependency, match=message):
            OpenCvOptions(device=device).find_device()
        OpenCvOptions(device="rtsp://host/live").find_device()


def test_depth_is_16uc1_with_its_bytes() -> None:
    depth = np.arange(12, dtype=np.uint16).reshape(3, 4)
    image = to_image(depth, Header(1))
    assert (image.encoding, image.step, image.height, image.width) == ("16UC1", 8, 3, 4)
    np.testing.assert_array_equal(image.data.view(np.uint16).reshape(3, 4), depth)


class TestCalibration:
    def test_info_of_camera_calibration_is_published(self, video: Path, tmp_path: Path) -> None:
        (tmp_path / "top.yaml").write_text(
            "image_width: 64\nimage_height: 48\ndistortion_model: plumb_bob\n"
            "camera_matrix: {rows: 3, cols: 3, data: [50, 0, 32, 0, 50, 24, 0, 0, 1]}\n"
            "distortion_coefficients: {rows: 1, cols: 5, data: [0.1, 0, 0, 0, 0]}\n"
            "rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}\n"
            "projection_matrix: {rows: 3, cols: 4, data: [50, 0, 32, 0, 0, 50, 24, 0, 0, 0, 1, 0]}\n"
        )
        top = camera(host_context("top"), str(video), info=tmp_path / "top.yaml")
        top.open()
        ((topic, info),) = top.latched()
        top.close()
        assert topic == "/camera/top/camera_info"
        assert isinstance(info, CameraInfo)
        assert (info.width, info.k[2], info.d[0]) == (64, 32.0, 0.1)

    def test_calibration_for_another_size_is_reported(self, video: Path, tmp_path: Path) -> None:
        three = "{data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}"
        (tmp_path / "top.yaml").write_text(
            f"image_width: 640\nimage_height: 480\ncamera_matrix: {three}\nrectification_matrix: {three}\n"
            "distortion_coefficients: {data: [0, 0, 0, 0, 0]}\n"
            "projection_matrix: {data: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0]}\n"
        )
        top = camera(host_context("top"), str(video), info=tmp_path / "top.yaml")
        top.open()
        with pytest.raises(SensorError, match=r"top\.yaml: is for images of 640x480, these are 64x48"):
            top.read(0.0)
        top.close()

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("[]", "must be a mapping"),
            ("image_width: a\nimage_height: 2", "must be whole numbers, not 'a' and 2"),
            ("image_width: 1\nimage_height: 2", "distortion_coefficients: must have `data`"),
            ("a: [", "cannot be read"),
        ],
    )
    def test_a_file_without_a_calibration_is_reported(
        self, video: Path, tmp_path: Path, text: str, message: str
    ) -> None:
        (tmp_path / "top.yaml").write_text(text)
        with pytest.raises(SensorError, match=message):
            camera(host_context("top"), str(video), info=tmp_path / "top.yaml").open()

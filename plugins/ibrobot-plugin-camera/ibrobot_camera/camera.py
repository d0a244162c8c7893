"""The sensor `opencv`: the newest image of a live source, or a video file at its own rate."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import override

import attrs
from ibrobot_ros2.jpeg import to_jpeg

from ibrobot_camera.calibration import load_info
from ibrobot_camera.capture import DEPTHS, Capture, Picture, Pixels
from ibrobot_camera.device import find_device
from ibrobot_camera.options import OpenCvOptions
from ibrobot_core.api import (
    NS_PER_S,
    CameraInfo,
    CompressedImage,
    Context,
    Header,
    Image,
    Message,
    Sensor,
    SensorError,
    SteppedClock,
    ns,
)
from ibrobot_core.app import raise_thread_priority

_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.1, 2.0
"""Time between attempts to reopen a lost source."""
_CLOSE_S = 5.0


class OpenCvCamera(Sensor):
    """Images of a V4L2 device or a network stream, read by a thread that keeps only the newest; or of a video file.

    With `encoding: jpeg` they are `CompressedImage`: the original bytes if the source sends JPEG and `rotation` is 0.

    Args:
        options: options from the YAML.
        ctx: name, clock and logger.

    Raises:
        SensorError: if the device does not exist, or the calibration cannot be read.
    """

    def __init__(self, options: OpenCvOptions, ctx: Context) -> None:
        self._as_jpeg = wants_jpeg(options)
        self.message_type = CompressedImage if self._as_jpeg else Image
        self.topic = f"/camera/{ctx.name}/image_raw"
        self._options = options
        self._ctx = ctx
        self._frame_id = options.frame_id or f"{ctx.name}_optical_frame"
        self._source: _Live | _File | None = None
        self._info: Callable[[Header], CameraInfo] | None = None
        self._last_ns = 0

    @override
    def open(self) -> None:
        try:
            device = find_device(self._options.device)
            self._info = load_info(self._options.info) if self._options.info is not None else None
        except SensorError as error:
            raise SensorError(f"camera {self._ctx.name}: {error}") from None
        if device.kind != "file" and isinstance(self._ctx.clock, SteppedClock):
            raise SensorError(
                f"camera {self._ctx.name}: {device}: a live source cannot run in lockstep; a video file can"
            )
        make = _File if device.kind == "file" else _Live
        source = make(lambda: Capture(device, self._options, self._ctx.name), self._options, self._ctx)
        source.open()
        self._source = source

    @override
    def read(self, timeout_s: float) -> Image | CompressedImage | None:
        if self._source is None:
            raise SensorError(f"camera {self._ctx.name}: not open")
        frame = self._source.read(timeout_s)
        if frame is None:
            return None
        picture, stamp_ns = frame
        self._check_calibration(picture.size)
        # A driver that repeats a stamp must not give two images with the same time.
        self._last_ns = stamp_ns = max(stamp_ns, self._last_ns + 1)
        return self._message(picture.content, Header(stamp_ns, self._frame_id))

    def _message(self, content: Pixels | CompressedImage, header: Header) -> Image | CompressedImage:
        if isinstance(content, CompressedImage):
            return attrs.evolve(content, header=header)
        image = to_image(content, header)
        return to_jpeg(image, self._options.jpeg_quality) if self._as_jpeg else image

    @override
    def close(self) -> None:
        source, self._source = self._source, None
        if source is not None:
            source.close()

    def _check_calibration(self, size: tuple[int, int]) -> None:
        if self._info is None:
            return
        calibrated, (height, width) = self._info(Header()), size
        if (calibrated.width, calibrated.height) != (width, height):
            raise SensorError(
                f"camera {self._ctx.name}: {self._options.info}: is for images of "
                f"{calibrated.width}x{calibrated.height}, these are {width}x{height}"
            )

    @override
    def latched(self) -> tuple[tuple[str, Message], ...]:
        if self._info is None or self._source is None:
            return ()
        info: CameraInfo = self._info(Header(self._ctx.clock.now_ns(), self._frame_id))
        return ((f"/camera/{self._ctx.name}/camera_info", info),)


def wants_jpeg(options: OpenCvOptions) -> bool:
    """Whether messages are JPEG."""
    return options.encoding == "jpeg" and options.fourcc not in DEPTHS


def to_image(pixels: Pixels, header: Header) -> Image:
    """An image as a message: bgr8, mono8, or 16UC1 for depth."""
    height, width = pixels.shape[:2]
    encoding = "16UC1" if pixels.dtype == "uint16" else "bgr8" if pixels.ndim == 3 else "mono8"
    flat = pixels.reshape(-1).view("uint8")
    return Image(header, height, width, encoding, flat.size // height, flat)


class _Live:
    """A live source: a thread reads every image and keeps the newest."""

    def __init__(self, make: Callable[[], Capture], options: OpenCvOptions, ctx: Context) -> None:
        self._make = make
        self._patience_s = options.reconnect_timeout
        self._as_jpeg = wants_jpeg(options)
        self._ctx = ctx
        self._changed = threading.Condition()
        self._newest: Picture | None = None
        self._error: SensorError | None = None
        self._ended = threading.Event()

    def open(self) -> None:
        capture = self._make()
        for difference in capture.differences:
            self._ctx.log.warning("camera %s %s", self._ctx.name, difference)
        if self._as_jpeg and not capture.own_jpeg:
            self._ctx.log.info("camera %s does not send JPEG; its images are encoded once, here", self._ctx.name)
        self._thread = threading.Thread(target=self._run, args=(capture,), name=f"camera {self._ctx.name}", daemon=True)
        self._thread.start()

    def read(self, timeout_s: float) -> tuple[Picture, int] | None:
        with self._changed:
            if self._newest is None and self._error is None and timeout_s > 0:
                self._changed.wait(timeout_s)
            picture, self._newest = self._newest, None
            if picture is not None:
                age_ns = time.monotonic_ns() - picture.taken_ns
                return picture, self._ctx.clock.now_ns() - age_ns
            if self._error is not None:
                raise self._error
            return None

    def close(self) -> None:
        self._ended.set()
        self._thread.join(_CLOSE_S)

    def _run(self, capture: Capture) -> None:
        raise_thread_priority()
        warned = False
        try:
            while not self._ended.is_set():
                picture = capture.read()
                if picture is None:
                    capture.close()
                    failure = self._reconnect()
                    if failure is None:
                        return
                    capture = failure
                    continue
                if capture.lacks_stamps and not warned:
                    warned = True
                    self._ctx.log.warning(
                        "camera %s: its driver gives no time stamps; images get the time at which they arrive",
                        self._ctx.name,
                    )
                with self._changed:
                    self._newest = picture
                    self._changed.notify()
        finally:
            capture.close()

    def _reconnect(self) -> Capture | None:
        """The reopened source, or None if the camera was closed or the timeout has passed."""
        self._ctx.log.warning("camera %s is lost; trying for %g s", self._ctx.name, self._patience_s)
        lost, pause_s = time.monotonic(), _FIRST_PAUSE_S
        while True:
            try:
                capture = self._make()
            except SensorError as error:
                last = error
            else:
                self._ctx.log.warning("camera %s is back after %.1f s", self._ctx.name, time.monotonic() - lost)
                return capture
            if time.monotonic() - lost >= self._patience_s:
                with self._changed:
                    self._error = SensorError(f"{last}; it was lost and did not return within {self._patience_s:g} s")
                    self._changed.notify()
                return None
            if self._ended.wait(pause_s):
                return None
            pause_s = min(2 * pause_s, _LONGEST_PAUSE_S)


class _File:
    """A video file: image `i` is due `i / rate` after it was opened, by the clock."""

    def __init__(self, make: Callable[[], Capture], options: OpenCvOptions, ctx: Context) -> None:
        self._make = make
        self._options = options
        self._ctx = ctx

    def open(self) -> None:
        self._capture: Capture | None = self._make()
        rate = self._options.fps or self._capture.fps
        if not rate:
            self._capture.close()
            raise SensorError(f"camera {self._ctx.name}: the file does not state its rate; set fps")
        self._period_ns = ns(1.0 / rate)
        self._begun_ns = self._ctx.clock.now_ns()
        self._next = 0

    def read(self, timeout_s: float) -> tuple[Picture, int] | None:
        clock = self._ctx.clock
        due_ns = self._begun_ns + self._next * self._period_ns
        now_ns = clock.now_ns()
        if due_ns > now_ns:
            if due_ns - now_ns > timeout_s * NS_PER_S:
                if timeout_s > 0:
                    clock.sleep_until(now_ns + ns(timeout_s))
                return None
            clock.sleep_until(due_ns)
            now_ns = clock.now_ns()
        # If several are due, return only the newest, with the time at which it was due.
        picture = None
        while due_ns <= now_ns:
            newer = self._picture()
            if newer is None:
                break
            picture, stamp_ns = newer, due_ns
            self._next += 1
            due_ns += self._period_ns
        if picture is None:  # the file has ended
            clock.sleep_until(now_ns + ns(timeout_s))
            return None
        return picture, stamp_ns

    def close(self) -> None:
        if self._capture is not None:
            self._capture.close()
            self._capture = None

    def _picture(self) -> Picture | None:
        if self._capture is None:
            return None
        picture = self._capture.read()
        if picture is None and self._options.loop:
            self._capture.close()
            self._capture = self._make()
            picture = self._capture.read()
        return picture

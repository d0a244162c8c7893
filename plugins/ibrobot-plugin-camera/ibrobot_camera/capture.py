"""An open image source, through OpenCV: configured as requested, verified, and stamped."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import attrs
import cv2
import numpy as np
from ibrobot_ros2.jpeg import own_jpeg
from numpy.typing import NDArray

from ibrobot_camera.device import LIST, NO_DEVICE, Device
from ibrobot_camera.options import OpenCvOptions
from ibrobot_camera.v4l2 import Mode, modes
from ibrobot_core.api import NS_PER_S, CompressedImage, ContractError, Header, SensorError

DEPTHS = ("Y16 ", "Z16 ")
"""Formats with 16 bits per pixel, which JPEG does not support."""
_MJPG = "MJPG"

type Pixels = NDArray[np.uint8] | NDArray[np.uint16]

_TIMEOUT_MS = 3000
"""A network stream that is silent for this long is lost."""
_DAMAGED = 30
"""After this many undecodable images in a row the source is lost; single ones, common over USB, are skipped."""
_STREAM_OPTIONS = "rtsp_transport;tcp|fflags;nobuffer|flags;low_delay"
_environment = threading.Lock()
_MANUAL_EXPOSURE, _AUTO_EXPOSURE = 1, 3
"""V4L2_EXPOSURE_MANUAL, V4L2_EXPOSURE_APERTURE_PRIORITY."""
_ROTATIONS: Mapping[int, int] = {
    90: cv2.ROTATE_90_CLOCKWISE,
    180: cv2.ROTATE_180,
    270: cv2.ROTATE_90_COUNTERCLOCKWISE,
}
# OpenCV's log is silenced, because failures are raised as this package's errors.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
_SILENT = 0
_set_log_level = getattr(cv2, "setLogLevel", None) or cv2.utils.logging.setLogLevel  # OpenCV 4, OpenCV 5
_set_log_level(_SILENT)
# By default a silent device blocks the reader, and thus the end of a run, for 10 s.
os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", str(_TIMEOUT_MS // 1000))


@attrs.frozen(eq=False)
class Picture:
    """An image and the time at which it was taken."""

    content: Pixels | CompressedImage
    """(H, W, 3) uint8, BGR; (H, W) uint8 or, for depth, uint16; or the camera's JPEG, without a stamp."""
    size: tuple[int, int]
    """Height and width [px]."""
    taken_ns: int
    """`time.monotonic_ns()`: the driver's stamp if it has one, otherwise the time of arrival."""


class Capture:
    """An open source.

    Args:
        device: the source.
        options: options from the YAML.
        name: the camera's name, for messages.

    Raises:
        SensorError: if it cannot be opened, or if `strict` is set and the images differ from the request.
    """

    def __init__(self, device: Device, options: OpenCvOptions, name: str) -> None:
        self._device = device
        self._options = options
        self._name = name
        self._capture = self._open()
        try:
            if device.kind == "v4l2":
                self._set_up()
            self.own_jpeg = self._take_jpeg()
            """Whether images are the source's own JPEG."""
            self.differences = self._differences()
            """Differences between the request and what the source delivers."""
            if self.differences and options.strict:
                raise self._error(f"{'; '.join(self.differences)}{self._offered()}; `strict: false` accepts it")
        except BaseException:
            self._capture.release()
            raise
        self.fps = float(self._capture.get(cv2.CAP_PROP_FPS))
        """Images per second, as reported by the source [Hz]; 0 if unknown."""
        self.lacks_stamps = False
        """Whether this is a V4L2 device whose last image has no plausible stamp, but that of its arrival."""

    def read(self) -> Picture | None:
        """The next image; None at the end of a file, or if the source is lost."""
        for _ in range(_DAMAGED):
            if not self._capture.grab():
                return None
            taken_ns = self._taken_ns(time.monotonic_ns())  # before decoding, which takes time
            good, pixels = self._capture.retrieve()
            picture = self._picture(pixels, taken_ns) if good else None
            if picture is not None:
                return picture
        return None

    def _picture(self, pixels: NDArray[Any], taken_ns: int) -> Picture | None:
        """The retrieved pixels as a picture; None if they are damaged."""
        if self.own_jpeg:
            try:
                return Picture(*own_jpeg(np.ascontiguousarray(pixels).reshape(-1), Header()), taken_ns)
            except ContractError:
                return None
        if self._options.fourcc == "Z16 ":
            good, pixels = self._depth(pixels)
            if not good:
                return None
        if self._options.rotation:
            pixels = cv2.rotate(pixels, _ROTATIONS[self._options.rotation])
        height, width = pixels.shape[:2]
        return Picture(np.ascontiguousarray(pixels), (height, width), taken_ns)

    def _depth(self, pixels: NDArray[Any]) -> tuple[bool, NDArray[Any]]:
        """Whether a Z16 image is complete, and its depths; OpenCV does not decode Z16, it returns bytes in one row."""
        get = self._capture.get
        height, width = round(get(cv2.CAP_PROP_FRAME_HEIGHT)), round(get(cv2.CAP_PROP_FRAME_WIDTH))
        if pixels.nbytes != 2 * height * width:
            return False, pixels
        return True, pixels.reshape(-1).view(np.uint16).reshape(height, width)

    def close(self) -> None:
        """Release the source."""
        self._capture.release()

    def _open(self) -> cv2.VideoCapture:
        device = self._device
        if device.kind == "v4l2":
            if not os.path.exists(device.target):
                raise self._error(f"{NO_DEVICE}; {LIST}")
            if not os.access(device.target, os.R_OK | os.W_OK):
                raise self._error("no permission: add yourself to the group `video`, then log in again")
            capture = cv2.VideoCapture(device.target, cv2.CAP_V4L2)
            why = "cannot be opened; another program may hold it"
        elif device.kind == "stream":
            timeouts = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, _TIMEOUT_MS, cv2.CAP_PROP_READ_TIMEOUT_MSEC, _TIMEOUT_MS]
            with _stream_options():
                capture = cv2.VideoCapture(device.target, cv2.CAP_FFMPEG, timeouts)
            why = f"cannot be opened within {_TIMEOUT_MS / 1e3:.0f} s; check the address and that the server runs"
        else:
            capture = cv2.VideoCapture(device.target, cv2.CAP_FFMPEG)
            why = "is not a video that can be decoded"
            if capture.isOpened() and not capture.grab():
                code = int(capture.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little").decode(errors="replace")
                capture.release()
                raise self._error(f"OpenCV cannot decode its images (video format {code}); use MJPG or H.264")
            capture = cv2.VideoCapture(device.target, cv2.CAP_FFMPEG)  # from the first image on
        if not capture.isOpened():
            capture.release()
            raise self._error(why)
        return capture

    def _fourcc(self) -> str | None:
        """The pixel format to request from a V4L2 device."""
        options = self._options
        if options.fourcc is not None:
            return options.fourcc
        offered = {mode.fourcc for mode in modes(self._device.target) if self._fits(mode)}
        return _MJPG if _MJPG in offered or not offered else None

    def _fits(self, mode: Mode) -> bool:
        """Whether a mode has the size and rate that the YAML requests."""
        size, fps = (self._options.width, self._options.height), self._options.fps
        return (None in size or mode.size == size) and (fps is None or any(_equal(fps, r) for r in mode.rates_hz))

    def _take_jpeg(self) -> bool:
        """Whether to keep the source's JPEG unchanged; OpenCV then returns the bytes in one row."""
        if self._options.encoding != "jpeg" or self._options.rotation or self._format() != _MJPG:
            return False
        prop, value = (cv2.CAP_PROP_CONVERT_RGB, 0) if self._device.kind == "v4l2" else (cv2.CAP_PROP_FORMAT, -1)
        return self._capture.set(prop, value)

    def _format(self) -> str:
        return int(self._capture.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little").decode(errors="replace")

    def _set_up(self) -> None:
        options, capture = self._options, self._capture
        # Set the format first: it determines the available sizes, and the size determines the rates.
        fourcc = self._fourcc()
        if fourcc is not None:
            capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*fourcc))
            if fourcc in DEPTHS:
                capture.set(cv2.CAP_PROP_CONVERT_RGB, 0)
        if options.width is not None and options.height is not None:
            capture.set(cv2.CAP_PROP_FRAME_WIDTH, options.width)
            capture.set(cv2.CAP_PROP_FRAME_HEIGHT, options.height)
        if options.fps is not None:
            capture.set(cv2.CAP_PROP_FPS, options.fps)
        automatic = options.exposure is None
        capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, _AUTO_EXPOSURE if automatic else _MANUAL_EXPOSURE)
        self._control("exposure", cv2.CAP_PROP_EXPOSURE, options.exposure)
        capture.set(cv2.CAP_PROP_AUTO_WB, float(options.white_balance is None))
        self._control("white_balance", cv2.CAP_PROP_WB_TEMPERATURE, options.white_balance)
        self._control("brightness", cv2.CAP_PROP_BRIGHTNESS, options.brightness)

    def _control(self, name: str, prop: int, value: float | None) -> None:
        if value is not None and not self._capture.set(prop, value):
            raise self._error(f"does not accept {name}: {value:g}")

    def _differences(self) -> list[str]:
        options, get = self._options, self._capture.get
        differences = []
        size = round(get(cv2.CAP_PROP_FRAME_WIDTH)), round(get(cv2.CAP_PROP_FRAME_HEIGHT))
        if options.width is not None and size != (options.width, options.height):
            differences.append(f"delivers {size[0]}x{size[1]} instead of {options.width}x{options.height}")
        # The sender determines a stream's rate, and FFmpeg often only guesses it.
        rate = get(cv2.CAP_PROP_FPS) if self._device.kind != "stream" else 0.0
        if options.fps is not None and rate and not _equal(options.fps, rate):
            differences.append(f"delivers {rate:g} Hz instead of {options.fps:g}")
        code = self._format()
        if self._device.kind == "v4l2" and options.fourcc is not None and code != options.fourcc:
            differences.append(f"delivers format {code} instead of {options.fourcc}")
        return differences

    def _offered(self) -> str:
        offered = modes(self._device.target) if self._device.kind == "v4l2" else ()
        lines = ("{} {} at {}".format(*mode.row) for mode in offered[:12])
        return f"; it offers: {'; '.join(lines)}" if offered else ""

    def _taken_ns(self, now_ns: int) -> int:
        # OpenCV's V4L2 backend returns the buffer's stamp, which drivers take from the monotonic clock.
        if self._device.kind == "v4l2":
            stamp_ns = round(self._capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
            if now_ns - NS_PER_S < stamp_ns <= now_ns:
                self.lacks_stamps = False
                return stamp_ns
            self.lacks_stamps = True
        return now_ns

    def _error(self, what: str) -> SensorError:
        return SensorError(f"camera {self._name}: {self._device}: {what}")


def _equal(asked_hz: float, given_hz: float) -> bool:
    """Whether two rates are equal; drivers round them."""
    return abs(given_hz - asked_hz) <= 0.01 * asked_hz


@contextmanager
def _stream_options() -> Iterator[None]:
    """FFmpeg's low-latency options, which OpenCV reads from the environment only.

    They are removed afterwards, because they make a video file lose its first image.
    """
    name = "OPENCV_FFMPEG_CAPTURE_OPTIONS"
    with _environment:
        before = os.environ.get(name)
        os.environ[name] = before or _STREAM_OPTIONS
        try:
            yield
        finally:
            if before is None:
                del os.environ[name]

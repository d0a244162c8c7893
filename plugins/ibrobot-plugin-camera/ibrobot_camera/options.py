"""Options of cameras."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import attrs

from ibrobot_camera.device import LIST, NO_DEVICE, find_device
from ibrobot_core.api import Header, MissingDependency, OptionFault, Options, SensorError, documented, option

if TYPE_CHECKING:
    from ibrobot_core.api import Robot

ENCODING = option(
    "jpeg",
    choices=("jpeg", "raw"),
    help="of messages: jpeg publishes the camera's own JPEG, or else encodes once; depth is always raw",
)
JPEG_QUALITY = option(90, ge=1, le=100, help="JPEG quality of images that the camera does not send as JPEG")


class Calibrated(Options):
    """Options of a camera that may have a calibration file."""

    info: Path | None

    def check(self, robot: Robot, joints: tuple[str, ...]) -> Iterable[OptionFault]:
        """Check that the calibration file can be read."""
        if self.info is not None:
            from ibrobot_camera.calibration import load_info

            try:
                load_info(self.info)
            except SensorError as error:
                yield OptionFault(("info",), str(error))

    @property
    def lens(self) -> Mapping[str, Any]:
        """The intrinsics in the calibration file.

        Raises:
            SensorError: if it cannot be read, or there is none.
        """
        from ibrobot_camera.calibration import load_info
        from ibrobot_camera.rectify import facts_of

        if self.info is None:
            raise SensorError("needs `info` of the camera: a calibration file, as `ibrobot camera calibrate` writes it")
        return facts_of(load_info(self.info)(Header()))


@documented
@attrs.frozen
class OpenCvOptions(Calibrated):
    """Options of `type: opencv`: a V4L2 device, a network stream, or a video file."""

    device: int | str = option(
        help="a number, /dev/video0, a stable name under /dev/v4l/by-id or by-path, a URL, or a file"
    )
    width: int | None = option(None, unit="px", gt=0, help="image width; None: the source's")
    height: int | None = option(None, unit="px", gt=0, help="image height; None: the source's")
    fps: float | None = option(None, unit="Hz", gt=0, le=1000, help="images per second; None: the source's")
    fourcc: str | None = option(
        None,
        help="pixel format of a V4L2 device, e.g. MJPG or YUYV; None: MJPG if available, to save USB bandwidth",
    )
    encoding: str = ENCODING
    jpeg_quality: int = JPEG_QUALITY
    exposure: float | None = option(None, help="exposure of a V4L2 device, in its driver's unit; None: automatic")
    white_balance: float | None = option(None, unit="K", gt=0, help="white balance of a V4L2 device; None: automatic")
    brightness: float | None = option(None, help="brightness of a V4L2 device, in its driver's unit")
    rotation: int = option(0, unit="deg", choices=(0, 90, 180, 270), help="clockwise rotation of the images")
    strict: bool = option(True, help="whether a size, rate or format that differs from the requested one is an error")
    loop: bool = option(True, help="whether to repeat a video file")
    reconnect_timeout: float = option(30.0, unit="s", ge=0, help="how long to try to reopen a lost camera")
    frame_id: str = option("", help="frame id of the messages; NAME_optical_frame if empty")
    info: Path | None = option(None, help="calibration file in the format of ROS's camera_calibration (YAML)")

    def __attrs_post_init__(self) -> None:
        if (self.width is None) != (self.height is None):
            raise ValueError("set both width and height, or neither")
        if self.fourcc is not None and len(self.fourcc) != 4:
            raise ValueError(f"fourcc must have four characters, e.g. MJPG, not {self.fourcc!r}")

    def devices(self) -> Mapping[str, str]:
        """The resolved path of a V4L2 device; streams and files can be opened more than once."""
        try:
            device = find_device(self.device)
        except SensorError:
            return {}
        return {"device": os.path.realpath(device.target)} if device.kind == "v4l2" else {}

    def find_device(self) -> None:
        """Look for the V4L2 device or the video file.

        Raises:
            MissingDependency: if it is not there.
        """
        try:
            device = find_device(self.device)
        except SensorError as error:
            raise MissingDependency(str(error), remedy=LIST) from None
        if device.kind == "v4l2" and not os.path.exists(device.target):
            raise MissingDependency(f"{device.target}: {NO_DEVICE}", remedy=LIST)

    @property
    def picture(self) -> tuple[int, int] | None:
        """Height and width of the images [px]; None if only the source knows them."""
        if self.height is None or self.width is None:
            return None
        return self.height, self.width


@documented
@attrs.frozen
class RealSenseOptions(Calibrated):
    """Options of `type: realsense`, which needs the extra `realsense` of this package."""

    serial: str = option("", help="serial number; if empty, the only connected camera")
    stream: str = option("color", choices=("color", "depth"), help="depth: 16UC1 [mm], aligned to the colour images")
    width: int = option(640, unit="px", gt=0, help="image width")
    height: int = option(480, unit="px", gt=0, help="image height")
    fps: float = option(30.0, unit="Hz", gt=0, help="images per second")
    encoding: str = ENCODING
    jpeg_quality: int = JPEG_QUALITY
    frame_id: str = option("", help="frame id of the messages; NAME_optical_frame if empty")
    info: Path | None = option(
        None,
        help="calibration file as for `opencv`, in place of the intrinsics in the camera; needed for `rectify`",
    )

    def devices(self) -> Mapping[str, str]:
        """The stream of the camera."""
        camera = f"RealSense {self.serial}" if self.serial else "the only RealSense"
        return {"serial": f"the {self.stream} stream of {camera}"}

    @property
    def picture(self) -> tuple[int, int]:
        """Height and width of the images [px]."""
        return self.height, self.width

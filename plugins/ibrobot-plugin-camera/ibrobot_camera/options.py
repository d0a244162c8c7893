"""What the YAML may say of a camera."""

from __future__ import annotations

from pathlib import Path

import attrs

from ibrobot_core.api import documented, option

ENCODING = option(
    "jpeg", choices=("jpeg", "raw"),
    help="of messages: jpeg is the camera's own bytes where it sends JPEG, else encoded once; depth is always raw",
)  # fmt: skip
JPEG_QUALITY = option(90, ge=1, le=100, help="of pictures that the camera does not send as JPEG itself")


@documented
@attrs.frozen
class OpenCvOptions:
    """Options of `type: opencv`: a V4L2 device, a network stream, or a video file."""

    device: int | str = option(
        help="a number, /dev/video0, a name under /dev/v4l/by-id (which stays the same), a URL, or a video file"
    )
    width: int | None = option(None, unit="px", gt=0, help="None: as the source gives it")
    height: int | None = option(None, unit="px", gt=0, help="None: as the source gives it")
    fps: float | None = option(None, unit="Hz", gt=0, le=1000, help="None: as the source gives it")
    fourcc: str | None = option(
        None,
        help="pixel format of a V4L2 device, e.g. MJPG or YUYV; None: MJPG where it is offered, to save the bus",
    )
    encoding: str = ENCODING
    jpeg_quality: int = JPEG_QUALITY
    exposure: float | None = option(None, help="of a V4L2 device, in its driver's unit; None: automatic")
    white_balance: float | None = option(None, unit="K", gt=0, help="of a V4L2 device; None: automatic")
    brightness: float | None = option(None, help="of a V4L2 device, in its driver's unit")
    rotation: int = option(0, unit="deg", choices=(0, 90, 180, 270), help="clockwise, of the pictures")
    strict: bool = option(True, help="whether size, rate or format that differ from what was asked are an error")
    loop: bool = option(True, help="whether a video file begins again at its end")
    reconnect_timeout: float = option(30.0, unit="s", ge=0, help="how long to try after the camera was lost")
    frame_id: str = option("", help="of the messages; NAME_optical_frame where it is empty")
    info: Path | None = option(None, help="calibration as ROS's camera_calibration writes it (YAML)")

    def __attrs_post_init__(self) -> None:
        if (self.width is None) != (self.height is None):
            raise ValueError("width and height belong together: give both or none")
        if self.fourcc is not None and len(self.fourcc) != 4:
            raise ValueError(f"fourcc has four characters, e.g. MJPG, not {self.fourcc!r}")


@documented
@attrs.frozen
class RealSenseOptions:
    """Options of `type: realsense`; needs the extra `realsense` of this package."""

    serial: str = option("", help="serial number; the only camera that is there where it is empty")
    stream: str = option("color", choices=("color", "depth"), help="depth: 16UC1 [mm], aligned to the colour pictures")
    width: int = option(640, unit="px", gt=0, help="of the pictures")
    height: int = option(480, unit="px", gt=0, help="of the pictures")
    fps: float = option(30.0, unit="Hz", gt=0, help="pictures a second")
    encoding: str = ENCODING
    jpeg_quality: int = JPEG_QUALITY
    frame_id: str = option("", help="of the messages; NAME_optical_frame where it is empty")


def picture_size(options: OpenCvOptions | RealSenseOptions) -> tuple[int, int] | None:
    """Height and width of the pictures [px]; None where only the source knows them."""
    if options.height is None or options.width is None:
        return None
    return options.height, options.width

"""Sensor `lerobot`: a camera of LeRobot's."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any, override

import numpy as np
from ibrobot_ros2.jpeg import to_jpeg

from ibrobot_core.api import CompressedImage, Context, Header, Image, Message, Sensor, SensorError
from ibrobot_core.app import ChannelMessage
from ibrobot_lerobot_devices.link import DeviceLink, DeviceProblem, age_ns
from ibrobot_lerobot_devices.options import CameraOptions

_DEPTH = "16UC1"
_NO_PICTURE = "TimeoutError"
"""LeRobot's error if no picture comes in time."""


class LeRobotCamera(Sensor):
    """A camera of LeRobot's, in a process of its own. A picture has the time at which LeRobot says it was taken.

    Args:
        options: options from the YAML.
        ctx: name, clock and logger.
    """

    def __init__(self, options: CameraOptions, ctx: Context) -> None:
        self._as_jpeg = options.encoding == "jpeg" and not options.config.get("use_depth")
        self.message_type = CompressedImage if self._as_jpeg else Image
        self.topic = f"/camera/{ctx.name}/image_raw"
        self._options = options
        self._ctx = ctx
        self._frame_id = options.frame_id or f"{ctx.name}_optical_frame"
        self._link = DeviceLink("camera", options.camera, options.config, torch=options.torch)
        self._failing_s: float | None = None
        """Since when there are errors and no pictures [s]."""
        self._last_ns = 0

    @override
    def open(self) -> None:
        try:
            self._link.start(self._options.start_timeout)
        except DeviceProblem as problem:
            raise self._error(problem) from None
        self._failing_s = None

    @override
    def read(self, timeout_s: float) -> Message | None:
        if self._link.pid is None:
            raise self._error("not open")
        try:
            answer = self._link.picture(timeout_s)
        except DeviceProblem as problem:
            raise self._error(problem) from None
        if answer is None:
            return None
        if "error" not in answer:
            self._failing_s = None
            return self._message(answer)
        if not answer["error"].startswith(_NO_PICTURE):
            now_s = time.monotonic()
            self._failing_s = now_s if self._failing_s is None else self._failing_s
            if now_s - self._failing_s > self._options.lost_after:
                raise self._error(answer["error"])
        return None

    @override
    def close(self) -> None:
        self._link.end()

    def _message(self, answer: ChannelMessage) -> Message:
        # Two pictures never have the same time.
        stamp_ns = self._last_ns = max(self._ctx.clock.now_ns() - age_ns(answer), self._last_ns + 1)
        height, width, *channels = answer["shape"]
        pixels = np.frombuffer(answer.payload, np.uint8)
        image = Image(
            Header(stamp_ns, self._frame_id), height, width, self._encoding(answer, channels),
            pixels.size // height, pixels,
        )  # fmt: skip
        if self._as_jpeg and image.encoding == _DEPTH:
            raise self._error("LeRobot gives depth, which cannot be a JPEG; use encoding: raw")
        return to_jpeg(image, self._options.jpeg_quality) if self._as_jpeg else image

    def _encoding(self, answer: Mapping[str, Any], channels: list[int]) -> str:
        """The encoding of what the camera gives, whatever the YAML says."""
        match answer["type"], channels:
            case "uint16", [] | [1]:
                return _DEPTH
            case "uint8", [] | [1]:
                return "mono8"
            case "uint8", [3]:
                return f"{answer['color']}8"
        raise self._error(f"LeRobot gives pictures of shape {answer['shape']} and type {answer['type']}")

    def _error(self, text: object) -> SensorError:
        return SensorError(f"camera {self._ctx.name}: {text}")

"""Pictures on their way to pages: what a camera sends stays as it is if browsers show it; pixels become JPEG."""

from __future__ import annotations

import asyncio
from typing import Any

import attrs
import numpy as np
from ibrobot_ros2.jpeg import to_jpeg

from ibrobot_core.api import CompressedImage, Header, Image, Message, pixels
from ibrobot_web.link import JPEG, PICTURE_HEAD, PNG, RGB

PICTURES = (Image.ros_type, CompressedImage.ros_type)
"""Types of messages with pictures."""
_QUALITY = 80
_DEPTH_M = 4.0
"""Distance shown as black in pictures of depth [m]."""


@attrs.frozen
class Picture:
    """A picture as browsers show it."""

    content: bytes
    content_type: str


def to_payload(message: Message) -> bytes | None:
    """A picture message as the payload of a frame; None for messages without a picture that browsers show.

    Raises:
        ContractError: for a damaged picture.
    """
    if isinstance(message, CompressedImage):
        encoding = PNG if "png" in message.format.lower() else JPEG
        if "compresseddepth" in message.format.lower():
            return None
        return PICTURE_HEAD.pack(message.header.stamp_ns, 0, 0, encoding) + message.data.tobytes()
    if not isinstance(message, Image):
        return None
    shown = _rgb(message)
    height, width, _ = shown.shape
    return PICTURE_HEAD.pack(message.header.stamp_ns, width, height, RGB) + shown.tobytes()


def _rgb(message: Image) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    """The pixels, shape (H, W, 3), RGB; depth from white (near) to black."""
    array: Any = pixels(message)
    match message.encoding:
        case "rgb8" | "rgba8":
            shown = array[..., :3]
        case "bgr8" | "bgra8":
            shown = array[..., 2::-1]
        case "mono8":
            shown = array.repeat(3, axis=2)
        case "mono16":
            shown = (array >> 8).repeat(3, axis=2)
        case _:
            metres = array * (1e-3 if message.encoding == "16UC1" else 1.0)
            near = np.where(np.isfinite(metres) & (metres > 0), 1.0 - metres / _DEPTH_M, 0.0)
            shown = (255 * np.clip(near, 0.0, 1.0)).repeat(3, axis=2)
    return np.ascontiguousarray(shown, dtype=np.uint8)


async def as_jpeg(payload: bytes | memoryview) -> bytes | memoryview:
    """A payload that browsers show: pixels are encoded in a thread."""
    return payload if PICTURE_HEAD.unpack_from(payload)[3] != RGB else await asyncio.to_thread(_encoded, payload)


def to_picture(message: Message) -> Picture | None:
    """A picture message as browsers show it; None for messages without such a picture.

    Raises:
        ContractError: for a damaged picture.
    """
    payload = to_payload(message)
    if payload is None:
        return None
    if PICTURE_HEAD.unpack_from(payload)[3] == RGB:
        payload = _encoded(payload)
    kind = "image/png" if PICTURE_HEAD.unpack_from(payload)[3] == PNG else "image/jpeg"
    return Picture(payload[PICTURE_HEAD.size :], kind)


def _encoded(payload: bytes | memoryview) -> bytes:
    """Pixels as JPEG."""
    stamp_ns, width, height, _ = PICTURE_HEAD.unpack_from(payload)
    data = np.frombuffer(payload, np.uint8, offset=PICTURE_HEAD.size)
    image = Image(Header(stamp_ns), height, width, "rgb8", 3 * width, data)
    encoded = to_jpeg(image, _QUALITY)
    return PICTURE_HEAD.pack(stamp_ns, width, height, JPEG) + encoded.data.tobytes()

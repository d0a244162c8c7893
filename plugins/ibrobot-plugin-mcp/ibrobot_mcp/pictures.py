"""Pictures of the cameras of a run, for agents."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from typing import Any

import attrs
import numpy as np
from ibrobot_ros2.jpeg import fits_jpeg, to_jpeg
from ibrobot_ros2.run_cameras import camera_info, chosen_cameras, next_pictures

from ibrobot_core.api import (
    CameraInfo,
    CompressedImage,
    Image,
    Message,
    SensorError,
    TFMessage,
    TransformStamped,
    pixels,
)
from ibrobot_core.app import RunView, Subscription

_QUALITY = 85
_DEPTH_M = 4.0
"""Distance that is black in pictures of depth [m]."""
_TRANSFORMS = 10
"""Messages of transforms that are kept while pictures are waited for."""
_FRAMES = 10
"""Most frames between a camera and the base."""


@attrs.frozen
class Sight:
    """A picture, and what is known of its camera."""

    camera: str
    stamp_ns: int
    data: bytes
    kind: str
    """Its MIME type."""
    frame: str = ""
    note: str = ""
    intrinsics: Mapping[str, Any] | None = None
    """Width and height [px], `k`, row by row [px], and the distortion by its model; None without a calibration."""
    poses: list[Mapping[str, Any]] | None = None
    """The transforms from the camera's frame on, as far as they are known: metres, and quaternions x, y, z, w."""


def look(session: RunView, camera: str, timeout_s: float) -> list[Sight]:
    """The newest pictures of one camera, or of all.

    Raises:
        SensorError: without such a camera, or if it sends no picture within `timeout_s` [s].
    """
    wanted = chosen_cameras(session, camera)
    if not wanted:
        there = [name for name, each in session.config.peripherals.items() if each.kind == "camera"]
        has = f"its cameras are {', '.join(there)}, and none sends pictures" if there else "the robot has no camera"
        raise SensorError(f"{has}; `state` and `world` show the rest")
    with ExitStack() as stack:
        moving = _subscribed(stack, session, "/tf", _TRANSFORMS)
        messages = next_pictures(session, wanted, timeout_s)
        fixed = session.bus.latched().get("/tf_static")
        frames: dict[str, TransformStamped] = {}
        for each in (*([fixed] if fixed is not None else []), *moving.drain()):
            if isinstance(each.message, TFMessage):
                frames |= {transform.child_frame_id: transform for transform in each.message.transforms}
        return [_sight(session, name, wanted[name], message, frames) for name, message in messages.items()]


def _subscribed(stack: ExitStack, session: RunView, topic: str, depth: int) -> Subscription:
    subscription = session.bus.subscribe(topic, depth)
    stack.callback(subscription.close)
    return subscription


def _sight(session: RunView, name: str, topic: str, message: Message, frames: Mapping[str, TransformStamped]) -> Sight:
    if isinstance(message, CompressedImage):
        header, data = message.header, message.data.tobytes()
        kind, note = ("image/png" if "png" in message.format.lower() else "image/jpeg"), ""
    else:
        assert isinstance(message, Image)
        header, kind = message.header, "image/jpeg"
        deep = message.encoding in ("16UC1", "32FC1")
        note = f"depth: white is 0 m, black is {_DEPTH_M:g} m and more, or unknown" if deep else ""
        data = to_jpeg(message if fits_jpeg(message) else _eight_bits(message), _QUALITY).data.tobytes()
    info = camera_info(session, topic)
    intrinsics = _intrinsics(info) if info is not None else None
    return Sight(name, header.stamp_ns, data, kind, header.frame_id, note, intrinsics, _poses(frames, header.frame_id))


def _eight_bits(message: Image) -> Image:
    """A picture that JPEG can keep: without alpha, with depth from white (near) to black."""
    array: Any = pixels(message)
    if message.encoding in ("rgba8", "bgra8"):
        colours = np.ascontiguousarray(array[..., :3])
        kind = message.encoding.replace("a", "")
        return Image(message.header, message.height, message.width, kind, 3 * message.width, colours.reshape(-1))
    if message.encoding == "mono16":
        grey = (array >> 8).astype(np.uint8)
    else:
        metres = array * (1e-3 if message.encoding == "16UC1" else 1.0)
        near = np.where(np.isfinite(metres) & (metres > 0), 1.0 - metres / _DEPTH_M, 0.0)
        grey = (255 * np.clip(near, 0.0, 1.0)).astype(np.uint8)
    return Image(message.header, message.height, message.width, "mono8", message.width, grey.reshape(-1))


def _intrinsics(info: CameraInfo) -> Mapping[str, Any]:
    matrix, distortion = ([round(float(each), 6) for each in values] for values in (info.k, info.d))
    return {"width_px": info.width, "height_px": info.height, "k": matrix, info.distortion_model: distortion}


def _poses(frames: Mapping[str, TransformStamped], frame: str) -> list[Mapping[str, Any]] | None:
    transforms: list[Mapping[str, Any]] = []
    while frame in frames and len(transforms) < _FRAMES:
        each = frames[frame]
        frame, shift, turn = each.header.frame_id, each.translation, each.rotation
        transforms.append({
            "parent": frame,
            "child": each.child_frame_id,
            "translation_m": [round(value, 5) for value in (shift.x, shift.y, shift.z)],
            "quaternion": [round(value, 6) for value in (turn.x, turn.y, turn.z, turn.w)],
        })  # fmt: skip
    return transforms or None

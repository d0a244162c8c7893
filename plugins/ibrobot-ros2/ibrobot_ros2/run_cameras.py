"""The cameras of a run, by what is on its bus."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ibrobot_core.api import CameraInfo, CompressedImage, Image, Message, SensorError, pixels
from ibrobot_core.app import RunView
from ibrobot_ros2.pictures import decode_picture

_TYPES = (Image.ros_type, CompressedImage.ros_type)
_SIXTEEN_BITS = 256


def cameras(session: RunView) -> dict[str, str]:
    """Name of a camera -> its topic."""
    return {_name(topic): topic for topic, (kind, _) in session.bus.topics().items() if kind in _TYPES}


def chosen_cameras(session: RunView, camera: str) -> dict[str, str]:
    """Name -> topic of one camera, or of all if `camera` is empty.

    Raises:
        SensorError: without such a camera.
    """
    known = cameras(session)
    if camera and camera not in known:
        raise SensorError(f"no camera {camera[:80]!r} sends pictures; these do: {', '.join(known) or 'none'}")
    return {name: topic for name, topic in known.items() if camera in ("", name)}


def next_pictures(session: RunView, topics: Mapping[str, str], timeout_s: float) -> dict[str, Message]:
    """The next picture of each camera.

    Raises:
        SensorError: if one sends none within `timeout_s` [s].
    """
    with ExitStack() as stack:
        subscribed = {name: session.bus.subscribe(topic, 1) for name, topic in topics.items()}
        for each in subscribed.values():
            stack.callback(each.close)
        messages = {}
        for name, subscription in subscribed.items():
            received = subscription.get(timeout_s)
            if received is None:
                raise SensorError(f"camera {name} has sent no picture within {timeout_s:g} s")
            messages[name] = received.message
        return messages


def camera_info(session: RunView, topic: str) -> CameraInfo | None:
    """The calibration of the camera with a topic; None if it has none."""
    latched = session.bus.latched().get(f"{topic.rpartition('/')[0]}/camera_info")
    return latched.message if latched is not None and isinstance(latched.message, CameraInfo) else None


def rgb(message: Message) -> NDArray[np.uint8] | None:
    """The colours of a picture, shape (height, width, 3); None for depth, and for formats that nobody decodes.

    Raises:
        ContractError: for a damaged picture.
    """
    if isinstance(message, CompressedImage):
        decoded = decode_picture(message)
        return None if decoded is None else rgb(decoded)
    if not isinstance(message, Image) or message.encoding in ("16UC1", "32FC1"):
        return None
    array: Any = pixels(message)
    if message.encoding == "mono16":
        array = (array // _SIXTEEN_BITS).astype(np.uint8)
    array = np.atleast_3d(array)
    if array.shape[2] == 1:
        return np.ascontiguousarray(np.repeat(array, 3, axis=2))
    colours = array[..., 2::-1] if message.encoding.startswith("bgr") else array[..., :3]
    return np.ascontiguousarray(colours)


def _name(topic: str) -> str:
    parts = topic.strip("/").split("/")
    return parts[1] if len(parts) > 2 and parts[0] == "camera" else topic.strip("/").replace("/", "_")

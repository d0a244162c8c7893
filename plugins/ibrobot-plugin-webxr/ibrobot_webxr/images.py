"""The newest images of the robot's cameras, as JPEG."""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence

from ibrobot_ros2.jpeg import fits_jpeg, is_jpeg, to_jpeg

from ibrobot_core.api import CompressedImage, ContractError, Image, Message
from ibrobot_core.app import Bus, Subscription

_TOPIC = re.compile(r"/camera/([^/]+)/image_raw")
_TYPES = (Image.ros_type, CompressedImage.ros_type)
_QUALITY = 80


class CameraImages:
    """The cameras of a run and their newest images. Used by the server's thread alone.

    Args:
        bus: the bus of the run.
        cameras: names of the cameras; empty: all that publish.
        log: where damaged images are reported, once for each camera.
    """

    def __init__(self, bus: Bus, cameras: Sequence[str], log: logging.Logger) -> None:
        self._log = log
        self._damaged: set[str] = set()
        """Cameras whose first damaged image was logged."""
        self._bus = bus
        self._wanted = cameras
        self._subscriptions: dict[str, Subscription] = {}
        self.names: list[str] = []
        """Cameras that have published, in the order in which they were found; the list only grows."""
        self.newest: dict[str, tuple[int, bytes]] = {}
        """Camera -> number of its newest image, and the image."""

    def refresh(self) -> None:
        """Find cameras, and take their newest images."""
        for topic, (ros_type, _) in self._bus.topics().items():
            match = _TOPIC.fullmatch(topic)
            if match is None or ros_type not in _TYPES or topic in self._subscriptions:
                continue
            if not self._wanted or match[1] in self._wanted:
                self._subscriptions[topic] = self._bus.subscribe(topic, 1)
                self.names.append(match[1])
        for topic, subscription in self._subscriptions.items():
            received = subscription.get()
            if received is None:
                continue
            name = topic.split("/")[2]
            try:
                data = _jpeg(received.message)
            except ContractError as error:
                if name not in self._damaged:
                    self._damaged.add(name)
                    self._log.warning("webxr: camera %s: %s", name, error)
                continue
            if data is not None:
                number, _ = self.newest.get(name, (0, b""))
                self.newest[name] = number + 1, data

    def close(self) -> None:
        """End the subscriptions."""
        for subscription in self._subscriptions.values():
            subscription.close()


def _jpeg(message: Message) -> bytes | None:
    """An image as JPEG; None for images that browsers do not show, e.g. depth."""
    if isinstance(message, Image) and fits_jpeg(message):
        message = to_jpeg(message, _QUALITY)
    if isinstance(message, CompressedImage) and is_jpeg(message):
        return bytes(message.data)
    return None

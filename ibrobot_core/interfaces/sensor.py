"""Sensors: what turns a device into messages; runs in the host."""

from __future__ import annotations

from abc import ABC, abstractmethod

from ibrobot_core.messages import Message


class Sensor(ABC):
    """A source of messages. One thread calls `open`, `read` and `close`; it may differ from the constructor's.

    `topic` is where its messages go: `/camera/NAME/image_raw` for a camera.
    """

    topic: str
    message_type: type[Message]

    @abstractmethod
    def open(self) -> None:
        """Open the device.

        Raises:
            SensorError: e.g. no such device, or a format that it does not give.
        """

    @abstractmethod
    def read(self, timeout_s: float) -> Message | None:
        """The newest message not yet returned, waiting up to `timeout_s` [s]; None when none came.

        Its header stamp is the time of capture. An old frame never comes under a new stamp.

        Raises:
            SensorError: when the device is gone or not open.
        """

    @abstractmethod
    def close(self) -> None:
        """Release the device. Safe to call twice, and after a failed `open`."""

    def latched(self) -> tuple[tuple[str, Message], ...]:
        """Topics and messages published once, after `open`, e.g. a camera's CameraInfo."""
        return ()

"""Sensors, which publish the data of a device as messages, in the host."""

from __future__ import annotations

from abc import ABC, abstractmethod

from ibrobot_core.messages import Message


class Sensor(ABC):
    """A source of messages. One thread calls `open`, `read` and `close`; it may differ from the constructor's.

    `topic` is the topic of its messages: `/camera/NAME/image_raw` for a camera.
    """

    topic: str
    message_type: type[Message]
    idle: bool = False
    """Whether it makes no messages since they have no receiver; a run does not wait for its first one then."""

    @abstractmethod
    def open(self) -> None:
        """Open the device.

        Raises:
            SensorError: e.g. if the device does not exist, or does not offer the format.
        """

    @abstractmethod
    def read(self, timeout_s: float) -> Message | None:
        """The newest message that was not returned yet, waiting up to `timeout_s` [s]; None if none arrives.

        Its header stamp is the time of capture. Old data must never get a new stamp.

        Raises:
            SensorError: if the device is gone or not open.
        """

    @abstractmethod
    def close(self) -> None:
        """Release the device. Safe to call twice, and after a failed `open`."""

    def latched(self) -> tuple[tuple[str, Message], ...]:
        """Topics and messages published once, after `open`, e.g. a camera's CameraInfo."""
        return ()

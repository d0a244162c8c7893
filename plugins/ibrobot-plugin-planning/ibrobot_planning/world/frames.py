"""Frames of `/tf` and `/tf_static`: where a sensor is in the base frame."""

from __future__ import annotations

import numpy as np
from ibrobot_kinematics.poses import matrix

from ibrobot_core.api import Pose, TFMessage, TransformStamped, Vector
from ibrobot_core.app import Bus


class Frames:
    """The newest transforms on a bus."""

    def __init__(self, bus: Bus) -> None:
        self._subscriptions = [bus.subscribe(topic, 10, TFMessage) for topic in ("/tf_static", "/tf")]
        self._newest: dict[str, TransformStamped] = {}

    def pose(self, frame: str) -> Vector:
        """Pose of a frame in the frame at the root of its tree, shape (4, 4).

        Raises:
            ValueError: for an unknown frame.
        """
        for subscription in self._subscriptions:
            for received in subscription.drain():
                message = received.message
                assert isinstance(message, TFMessage)
                self._newest.update((each.child_frame_id, each) for each in message.transforms)
        if frame not in self._newest:
            raise ValueError(
                f"no transform of frame {frame!r}; peripherals[].transform says where a camera is mounted;"
                f" known frames: {', '.join(self._newest) or 'none'}"
            )
        placed = np.eye(4)
        for _ in self._newest:
            if frame not in self._newest:
                break
            found = self._newest[frame]
            placed = matrix(Pose(found.translation, found.rotation)) @ placed
            frame = found.header.frame_id
        return placed

    def close(self) -> None:
        """End the subscriptions."""
        for subscription in self._subscriptions:
            subscription.close()

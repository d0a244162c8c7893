"""A camera for LeRobot that needs no device, `type: made_up`; LeRobot finds the class beside its config."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from lerobot.cameras import Camera, CameraConfig
from numpy.typing import NDArray


class MadeUpCamera(Camera):  # type: ignore[misc]  # LeRobot is not installed where types are checked
    """A camera of LeRobot's that needs no device."""

    def __init__(self, config: Any) -> None:
        super().__init__(config)
        self._connected = False

    @property
    def is_connected(self) -> bool:
        return self._connected

    @staticmethod
    def find_cameras() -> list[dict[str, Any]]:
        return []

    def connect(self, warmup: bool = True) -> None:
        self._connected = True

    def read(self) -> NDArray[np.uint8]:
        return np.full((self.height, self.width, 3), 90, np.uint8)

    def async_read(self, timeout_ms: float = 200) -> NDArray[np.uint8]:
        return self.read()

    def read_latest(self, max_age_ms: int = 500) -> NDArray[np.uint8]:
        return self.read()

    def disconnect(self) -> None:
        self._connected = False


@CameraConfig.register_subclass("made_up")
@dataclass
class MadeUpCameraConfig(CameraConfig):  # type: ignore[misc]
    """Its config."""

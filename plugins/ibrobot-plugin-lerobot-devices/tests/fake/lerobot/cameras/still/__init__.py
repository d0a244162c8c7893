"""A camera whose picture is a file: it captures whenever the file is new."""

# mypy: disable-error-code="misc"

import time
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from lerobot.cameras import CameraConfig


class Order(StrEnum):
    """Orders of colours."""

    RGB = "rgb"
    BGR = "bgr"


class Still:
    """The camera."""

    def __init__(self, config: Any) -> None:
        self.config = config
        self.latest_timestamp: float | None = None
        if config.color_mode is not None:
            self.color_mode = Order(config.color_mode.lower()) if config.as_enum else config.color_mode
        self._seen = ""

    def connect(self) -> None:
        if not Path(self.config.path).exists():
            raise ConnectionError(f"no camera {self.config.path}")

    def async_read(self, timeout_ms: float = 200) -> Any:
        deadline_s = time.monotonic() + timeout_ms / 1e3
        while (content := Path(self.config.path).read_text()) == self._seen or not content:
            if self._seen and not self.config.waits:
                break
            if time.monotonic() > deadline_s:
                raise TimeoutError("Timed out waiting for frame")
            time.sleep(0.001)
        self._seen = content
        self.latest_timestamp = float(content.split()[1])
        shape = (self.config.height, self.config.width, self.config.channels)
        return np.full(shape, (int(content.split()[0]) % 250, 20, 30, 255)[: self.config.channels], self.config.kind)

    def disconnect(self) -> None:
        """There is nothing to release."""


@CameraConfig.register_subclass("fake_still")
@dataclass
class StillConfig(CameraConfig):
    """Its config."""

    device: ClassVar[type[Still]] = Still
    path: str = field(kw_only=True)
    width: int = 32
    height: int = 24
    channels: int = 3
    kind: str = "uint8"
    color_mode: str | None = "rgb"
    as_enum: bool = False
    waits: bool = True

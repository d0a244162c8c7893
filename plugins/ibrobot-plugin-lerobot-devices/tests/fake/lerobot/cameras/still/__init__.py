"""A camera whose picture is a file: it captures whenever the file is new."""

# mypy: disable-error-code="misc"

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from lerobot.cameras import CameraConfig


class Still:
    """The camera."""

    def __init__(self, config: Any) -> None:
        self.config = config
        self.latest_timestamp: float | None = None
        self._seen = ""

    def connect(self) -> None:
        if not Path(self.config.path).exists():
            raise ConnectionError(f"no camera {self.config.path}")

    def async_read(self, timeout_ms: float = 200) -> Any:
        deadline_s = time.monotonic() + timeout_ms / 1e3
        while (content := Path(self.config.path).read_text()) == self._seen or not content:
            if time.monotonic() > deadline_s:
                raise TimeoutError("Timed out waiting for frame")
            time.sleep(0.001)
        self._seen = content
        self.latest_timestamp = float(content.split()[1])
        return np.full((self.config.height, self.config.width, 3), (int(content.split()[0]) % 250, 20, 30), np.uint8)

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

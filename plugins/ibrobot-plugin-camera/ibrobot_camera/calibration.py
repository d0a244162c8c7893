"""Camera calibrations in the format of ROS's camera_calibration."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from ibrobot_core.api import CameraInfo, Header, SensorError

_MATRICES = {"distortion_coefficients": None, "camera_matrix": 9, "rectification_matrix": 9, "projection_matrix": 12}
"""Key -> number of its values."""


def load_info(path: Path) -> Callable[[Header], CameraInfo]:
    """Read a calibration file; returns a function that makes its CameraInfo.

    Raises:
        SensorError: if the file cannot be read or is incomplete; names file and key.
    """
    try:
        document = yaml.safe_load(path.read_text())
    except (OSError, UnicodeDecodeError, RecursionError, yaml.YAMLError) as error:
        raise SensorError(f"{path}: cannot be read: {error}") from None
    if not isinstance(document, dict):
        raise SensorError(f"{path}: must be a mapping, as camera_calibration writes it")
    height, width = document.get("image_height"), document.get("image_width")
    if type(height) is not int or type(width) is not int:
        stated = f"{width!r} and {height!r}"
        raise SensorError(f"{path}: image_width and image_height must be whole numbers, not {stated}")
    d, k, r, p = (_numbers(document, key, count, str(path)) for key, count in _MATRICES.items())
    model = str(document.get("distortion_model", "plumb_bob"))
    return lambda header: CameraInfo(header, height, width, model, d, k, r, p)


def _numbers(document: dict[str, Any], key: str, count: int | None, where: str) -> NDArray[np.float64]:
    entry = document.get(key)
    try:
        numbers = np.array(entry["data"], dtype=np.float64)  # type: ignore[index]
    except (TypeError, KeyError, ValueError, OverflowError):
        raise SensorError(f"{where}: {key}: must have `data`, a list of numbers, not {entry!r}") from None
    if numbers.ndim != 1 or (count is not None and numbers.size != count):
        raise SensorError(f"{where}: {key}: must have {count} numbers, not {numbers.size}")
    return numbers

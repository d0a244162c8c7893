"""Saves calibrations; after a crash, either the old or the new one is complete."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ibrobot_calibration import Calibration, calibration_path, companion_path

from ibrobot_core.api import CalibrationError

ZERO_AT: Mapping[str, str] = {
    "pose": "the pose that was set by hand at calibration (tick 2048)",
    "range": "the middle of each joint's calibrated range, as in LeRobot",
}
"""The choices for the position of 0 rad, with their meaning."""


def save_calibration(calibration: Calibration, name: str | Path, *, overwrite: bool = False) -> Path:
    """Save a calibration as LeRobot's JSON, and `NAME.meta.json` with arm, date, adapter, position of 0 rad, and hash.

    There are two files because LeRobot's loader refuses unknown keys.

    Args:
        calibration: the calibration to save.
        name: a name or a path, see `calibration_path`.
        overwrite: whether it may replace a file.

    Raises:
        CalibrationError: if the file exists already, or cannot be written.
    """
    path = calibration_path(name)
    if path.exists() and not overwrite:
        raise CalibrationError(f"{path}: exists already; choose another name, or allow overwriting it")
    meta = {
        "version": calibration.version,
        "robot": calibration.robot,
        "date": calibration.date,
        "zero_at": calibration.zero_at,
        "adapter": calibration.adapter,
        "sha256": calibration.fingerprint(),
    }
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # The companion comes first: without it, the file would be read as LeRobot's, with another 0 rad.
        _write_all({companion_path(path): meta, path: calibration.numbers()})
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be written: {error.strerror}") from None
    return path


def _write_all(documents: Mapping[Path, Mapping[str, Any]]) -> None:
    """Replace files in order, after all new ones are on the disk."""
    prepared: dict[Path, Path] = {}
    try:
        for path, document in documents.items():
            prepared[path] = _prepare(path, document)
        for path, temporary in prepared.items():
            temporary.replace(path)
    finally:
        for temporary in prepared.values():
            temporary.unlink(missing_ok=True)


def _prepare(path: Path, document: Mapping[str, Any]) -> Path:
    """Write a temporary file in the same folder as `path` with its new content."""
    descriptor, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(descriptor, "w") as file:
            json.dump(document, file, indent=4)
            file.write("\n")
            file.flush()
            os.fsync(file.fileno())
        Path(name).chmod(0o644)
    except BaseException:
        Path(name).unlink()
        raise
    return Path(name)

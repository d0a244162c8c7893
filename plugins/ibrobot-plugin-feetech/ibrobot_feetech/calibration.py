"""Saving a calibration, so that a crash leaves the old one or the new one."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ibrobot_core.api import Calibration, CalibrationError, calibration_path, companion_path


def save_calibration(
    calibration: Calibration, name: str | Path, *, overwrite: bool = False, by_id: bool = False
) -> Path:
    """Save a calibration as LeRobot's JSON, and beside it `NAME.meta.json`: arm, date, adapter, place of 0 rad, hash.

    Two files, since LeRobot's loader refuses keys that it does not know.

    Args:
        calibration: what to save.
        name: a name or a path, see `calibration_path`.
        overwrite: whether it may replace a file.
        by_id: write IB-Robot's layout, servo id -> numbers.

    Raises:
        CalibrationError: when there is one already, or it cannot be written.
    """
    path = calibration_path(name)
    if path.exists() and not overwrite:
        raise CalibrationError(f"{path}: is there already; give another name, or say that it may be overwritten")
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
        numbers = calibration.numbers()
        by_key = {str(joint["id"]): joint for joint in numbers.values()} if by_id else numbers
        # The companion comes first: numbers without it would be taken for LeRobot's, with 0 rad elsewhere.
        _write_all({companion_path(path): meta, path: by_key})
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be written: {error.strerror}") from None
    return path


def _write_all(documents: Mapping[Path, Mapping[str, Any]]) -> None:
    """Replace files in their order, once all of them are on the disk."""
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
    """A file beside `path` with its new content."""
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

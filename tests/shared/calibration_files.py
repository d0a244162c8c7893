"""Calibration files for tests."""

from __future__ import annotations

import json
from pathlib import Path

from ibrobot_calibration import Calibration, companion_path


def write_calibration(calibration: Calibration, path: Path) -> Path:
    """Write a calibration and its companion, and return the path."""
    facts = {name: getattr(calibration, name) for name in ("version", "robot", "date", "zero_at", "adapter")}
    companion_path(path).write_text(json.dumps({**facts, "sha256": calibration.fingerprint()}))
    path.write_text(json.dumps(calibration.numbers()))
    return path

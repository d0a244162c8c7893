"""Calibration files for tests."""

from __future__ import annotations

import json
from pathlib import Path

from hypothesis import strategies as st
from ibrobot_calibration import ZERO_AT, Calibration, JointCalibration, companion_path


def write_calibration(calibration: Calibration, path: Path) -> Path:
    """Write a calibration and its companion, and return the path."""
    facts = {name: getattr(calibration, name) for name in ("version", "robot", "date", "zero_at", "adapter")}
    companion_path(path).write_text(json.dumps({**facts, "sha256": calibration.fingerprint()}))
    path.write_text(json.dumps(calibration.numbers()))
    return path


@st.composite
def calibrations(draw: st.DrawFn) -> Calibration:
    """Calibrations of any joints."""
    names = draw(st.lists(st.sampled_from(["pan", "lift", "elbow", "wrist", "gripper"]), min_size=1, unique=True))
    joints = {}
    zero_at = draw(st.sampled_from(sorted(ZERO_AT)))
    for number, name in enumerate(names, 1):
        low = draw(st.integers(0, 4094))
        high = draw(st.integers(low + 1, 4095))
        drive_mode, offset = draw(st.integers(0, 1)), draw(st.integers(-2047, 2047))
        joints[name] = JointCalibration(number, drive_mode, offset, low, high, zero_at)
    return Calibration(joints, robot="left", date="2026-01-02T03:04:05+00:00")

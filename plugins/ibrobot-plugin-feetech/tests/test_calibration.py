"""Saving calibrations: LeRobot's and IB-Robot's layouts, and writes that fail."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import attrs
import pytest
from calibration_files import calibrations
from hypothesis import given
from hypothesis import strategies as st
from ibrobot_calibration import Calibration, JointCalibration, load_calibration
from ibrobot_feetech.calibration import save_calibration

from ibrobot_core.api import CalibrationError

GOOD: dict[str, Any] = {"id": 1, "drive_mode": 0, "homing_offset": -12, "range_min": 700, "range_max": 3400}


@given(calibrations(), st.booleans())
def test_what_is_saved_is_loaded(tmp_path_factory: pytest.TempPathFactory, made: Calibration, by_id: bool) -> None:
    path = tmp_path_factory.mktemp("c") / "arm.json"
    save_calibration(made, path)
    if by_id:  # as IB-Robot's files are
        path.write_text(json.dumps({str(joint["id"]): joint for joint in made.numbers().values()}))
    loaded = load_calibration(path, list(made.joints))
    assert loaded.joints == made.joints
    assert (loaded.robot, loaded.date, loaded.path) == (made.robot, made.date, path)


def test_the_file_holds_lerobots_keys_and_nothing_else(tmp_path: Path) -> None:
    made = Calibration({"pan": JointCalibration(**GOOD)}, robot="left", date="2026-01-02")
    save_calibration(made, tmp_path / "arm.json")
    assert json.loads((tmp_path / "arm.json").read_text()) == {"pan": GOOD}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["arm.json", "arm.meta.json"]


def test_it_overwrites_only_on_request(tmp_path: Path) -> None:
    made = Calibration({"pan": JointCalibration(**GOOD)})
    path = save_calibration(made, tmp_path / "arm.json")
    with pytest.raises(CalibrationError, match="exists already"):
        save_calibration(made, path)
    save_calibration(made, path, overwrite=True)


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(CalibrationError, match=r"file/arm\.json: cannot be written: "):
        save_calibration(Calibration({"pan": JointCalibration(**GOOD)}), tmp_path / "file" / "arm.json")


def test_a_failed_write_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = Calibration({"pan": JointCalibration(**GOOD)})
    path = save_calibration(made, tmp_path / "arm.json")

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(CalibrationError, match="No space left on device"):
        save_calibration(
            attrs.evolve(made, joints={"pan": JointCalibration(**{**GOOD, "range_min": 1})}), path, overwrite=True
        )
    assert load_calibration(path).joints == made.joints
    assert not list(tmp_path.glob(".*"))


def test_a_second_file_that_cannot_be_written_leaves_both_old_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = Calibration({"pan": JointCalibration(**GOOD)})
    path = save_calibration(made, tmp_path / "arm.json")
    left = iter([None, OSError(28, "No space left on device")])

    def full(descriptor: int) -> None:
        if (error := next(left)) is not None:
            raise error

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(CalibrationError, match="No space left on device"):
        save_calibration(made.with_zero_at("range"), path, overwrite=True)
    assert load_calibration(path).zero_at == "pose"
    assert not list(tmp_path.glob(".*"))

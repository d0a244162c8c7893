"""Calibration files: LeRobot's and IB-Robot's layouts, the companion, and every way in which one cannot be true."""

from __future__ import annotations

import json
import math
from pathlib import Path
from random import Random
from typing import Any

import attrs
import pytest
from calibration_files import calibrations, write_calibration
from hypothesis import given
from hypothesis import strategies as st
from ibrobot_calibration import Calibration, JointCalibration, calibration_path, load_calibration
from lerobot_units import angle, normalised

from ibrobot_core.api import CalibrationError

GOOD: dict[str, Any] = {"id": 1, "drive_mode": 0, "homing_offset": -12, "range_min": 700, "range_max": 3400}


def test_a_name_lies_in_the_configuration_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    assert calibration_path("left") == tmp_path / "ibrobot" / "calibration" / "left.json"
    assert calibration_path("here/left") == Path("here/left")
    assert calibration_path("left.json") == Path("left.json")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"homing_offset": 2048}, "homing_offset: must be -2047 to 2047, not 2048; the servo's horn"),
        ({"range_max": 4200}, r"range_max: must be 0 to 4095, not 4200; .* re-run .* the joint's middle in the middle"),
        ({"range_min": 3400}, r"range_min: must be below range_max \(3400\), not 3400"),
        ({"range_min": 3.9}, "range_min: must be a whole number, not 3.9"),
        ({"range_min": "5"}, "range_min: must be a whole number, not '5'"),
        ({"drive_mode": True}, "drive_mode: must be a whole number, not True"),
        ({"drive_mode": 2}, "drive_mode: must be 0 or 1, not 2"),
        ({"id": 254}, "id: must be 0 to 253, not 254"),
        ({"speed": 1}, "speed: unknown key; known: id, drive_mode, homing_offset, range_min, range_max"),
    ],
)
def test_what_cannot_be_true_is_refused_by_name(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    path = tmp_path / "arm.json"
    path.write_text(json.dumps({"pan": {**GOOD, **change}}, indent=1))
    line = list({**GOOD, **change}).index(next(iter(change))) + 3
    with pytest.raises(CalibrationError, match=rf"arm\.json:{line}: pan: {message}"):
        load_calibration(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{\n  broken", r"arm\.json:2: not JSON"),
        ("[]", "must be an object of joints"),
        ('{"pan": 5}', "pan: must be an object with id, drive_mode"),
        ('{"pan": {"id": 1}}', "pan: drive_mode: is missing"),
        (json.dumps({"a": GOOD, "b": GOOD}), "b: id: servo 1 belongs to a already"),
        ('{"pan": {}, "pan": {}}', "'pan' is there twice"),
        ('{"\\u0070an": 5}', "pan: must be an object with id, drive_mode"),
        ('{"\u00b2": 5}', "\u00b2: must be an object with id, drive_mode"),
        (f'{{"{"9" * 5000}": 5}}', "must be an object with id, drive_mode"),
        ("[" * 200_000, "cannot be read: maximum recursion depth"),
    ],
)
def test_files_that_are_none_are_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "arm.json").write_text(text)
    with pytest.raises(CalibrationError, match=message):
        load_calibration(tmp_path / "arm.json")


def test_a_missing_file_says_how_to_make_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    with pytest.raises(
        CalibrationError, match=r"no such calibration; `ibrobot arm calibrate --name \S+/arm.json` makes one"
    ):
        load_calibration(tmp_path / "arm.json", tool="ibrobot arm")
    with pytest.raises(
        CalibrationError, match="no such calibration; calibrate with the command of the hardware's plug"
    ):
        load_calibration(tmp_path / "arm.json")
    made = Calibration({"pan": JointCalibration(**GOOD)}, date="2026-01-02")
    calibration_path("left").parent.mkdir(parents=True)
    for name in ("right.v2", "left"):
        write_calibration(made, calibration_path(name))
    with pytest.raises(CalibrationError, match=r"name one of yours: left, right\.v2; or give the path of a file$"):
        load_calibration("theirs")


def test_a_missing_joint_is_named(tmp_path: Path) -> None:
    path = write_calibration(Calibration({"pan": JointCalibration(**GOOD)}), tmp_path / "arm.json")
    with pytest.raises(CalibrationError, match="has no joint 'lift'; it has: pan"):
        load_calibration(path, ["pan", "lift"])


def test_numbers_changed_behind_the_companions_back_are_refused(tmp_path: Path) -> None:
    made = Calibration({"pan": JointCalibration(**GOOD)}, date="2026-01-02")
    path = write_calibration(made, tmp_path / "arm.json")
    path.write_text(json.dumps({"pan": {**GOOD, "range_min": 701}}))
    remedy = r"`ibrobot arm import .*arm\.json --zero-at pose --yes`"
    with pytest.raises(CalibrationError, match=f"changed 20.*, are not those calibrated 2026-01-02 .* {remedy}"):
        load_calibration(path, tool="ibrobot arm")
    assert load_calibration(path, zero_at="range").joints["pan"].range_min == 701, "the numbers alone"


@given(calibrations(), st.integers(0, 4095))
def test_angles_of_lerobots_file_are_lerobots_degrees(
    tmp_path_factory: pytest.TempPathFactory, made: Calibration, ticks: int
) -> None:
    path = tmp_path_factory.mktemp("c") / "arm.json"
    path.write_text(json.dumps(made.numbers()))
    loaded = load_calibration(path)
    assert loaded.zero_at == "range"
    for joint in loaded.joints.values():
        # LeRobot divides a turn by 4095, not 4096, and does not turn inverted joints round.
        degrees = normalised(ticks, "degrees", joint) * 4095 / 4096
        assert math.degrees(angle(ticks, joint)) == pytest.approx(-degrees if joint.inverted else degrees, abs=1e-9)


def test_ib_robots_file_has_zero_at_the_pose(tmp_path: Path) -> None:
    (tmp_path / "arm.json").write_text(json.dumps({"1": GOOD}))
    assert load_calibration(tmp_path / "arm.json", ["pan"]).joints["pan"].zero() == 2048


@given(
    st.integers(1, 12), st.sampled_from(["numbers", "names", "names without ids"]), st.randoms(use_true_random=False)
)
def test_numbers_are_names_where_the_joints_have_them(
    tmp_path_factory: pytest.TempPathFactory, size: int, layout: str, random: Random
) -> None:
    """Robots of IB-Robot have joints "1" to "6"; for other robots the numbers are the servos, in the joints' order."""
    numbers = [str(number) for number in range(1, size + 1)]
    joints = numbers if layout == "numbers" else [f"joint{number}" for number in numbers]
    ids = dict(
        zip(numbers, random.sample(range(1, 254), size) if layout == "numbers" else range(1, size + 1), strict=True)
    )
    document = {name: {**GOOD, "id": ids[name], "range_min": 100 + int(name)} for name in random.sample(numbers, size)}
    if layout == "names without ids":
        document = {name: {key: each for key, each in row.items() if key != "id"} for name, row in document.items()}
    path = tmp_path_factory.mktemp("calibration") / "arm.json"
    path.write_text(json.dumps(document))
    for wanted in [joints, random.sample(joints, size), None] if layout == "numbers" else [joints]:
        found = load_calibration(path, wanted).joints
        assert {name: (each.id, each.range_min) for name, each in found.items()} == {
            joint: (ids[number], 100 + int(number)) for number, joint in zip(numbers, joints, strict=True)
        }


def test_a_companion_that_does_not_say_it_is_refused(tmp_path: Path) -> None:
    made = Calibration({"pan": JointCalibration(**GOOD)})
    path = write_calibration(made, tmp_path / "arm.json")
    companion = tmp_path / "arm.meta.json"
    meta = json.loads(companion.read_text())
    assert (meta["version"], meta.pop("zero_at")) == (2, "pose")
    companion.write_text(json.dumps({**meta, "version": 1}))
    with pytest.raises(CalibrationError, match=r"arm\.meta\.json: version: must be 2, not 1"):
        load_calibration(path)
    companion.write_text(json.dumps(meta))
    with pytest.raises(CalibrationError, match=r"arm\.meta\.json: zero_at: must be one of pose, range, not 'None'"):
        load_calibration(path)


def test_all_joints_have_zero_at_the_same_place() -> None:
    pan = JointCalibration(**GOOD)
    with pytest.raises(ValueError, match="zero_at: must be the same for all joints, not pose and range"):
        Calibration({"pan": pan, "lift": attrs.evolve(pan, id=2, zero_at="range")})
    with pytest.raises(ValueError, match="zero_at: must be one of pose, range, not 'home'"):
        attrs.evolve(pan, zero_at="home")


@pytest.mark.parametrize("drive_mode", [0, 1])
def test_a_gripper_is_anchored_at_its_closed_end(drive_mode: int) -> None:
    joint = JointCalibration(**{**GOOD, "drive_mode": drive_mode})
    closed = joint.range_max if drive_mode else joint.range_min
    assert angle(closed, joint, math.radians(-10)) == pytest.approx(math.radians(-10))
    assert joint.zero() == 2048

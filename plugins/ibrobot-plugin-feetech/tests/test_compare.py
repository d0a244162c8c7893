"""`feetech compare`: leader and follower in three poses."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import override

import pytest
from ibrobot_calibration import Calibration, JointCalibration
from ibrobot_feetech.calibration import save_calibration
from ibrobot_feetech.commands.compare import POSES, compare_arms
from ibrobot_feetech.commands.joints import SO101
from ibrobot_feetech.ticks import TICKS_PER_RADIAN
from ibrobot_terminal.fakes import FakeGuide

from ibrobot_core.api import CalibrationError, HardwareError

from .line import Line

ANGLES = {"at rest": -50.0, "in the middle": 0.0, "stretched": 40.0}
"""Beginning of a pose -> angle of all joints [degrees]."""


class Person(FakeGuide):
    """Puts both arms into the poses, as the joints truly stand."""

    def __init__(self, arms: Sequence[tuple[Line, Calibration, dict[str, float]]]) -> None:
        super().__init__()
        self._arms = arms

    @override
    def wait(self, request: str, **more: object) -> None:
        self.said.append(request)
        angle = math.radians(next(each for pose, each in ANGLES.items() if pose in request))
        for emulator, calibration, off in self._arms:
            for name, joint in calibration.joints.items():
                sign = -1 if name in off and math.isnan(off[name]) else 1
                shifted = sign * angle + math.radians(0.0 if sign < 0 else off.get(name, 0.0))
                emulator.servos[joint.id].turn(2048 + shifted * TICKS_PER_RADIAN)


@pytest.fixture
def arms(lines: None) -> Iterator[tuple[Line, Line]]:
    with Line(6) as follower, Line(6) as leader:
        yield follower, leader


def compared(arms: tuple[Line, Line], folder: Path, **off: float) -> tuple[bool, Person]:
    """Whether the arms agree, with joints of the leader off by angles [degrees]; NaN for a reversed one."""
    calibration = Calibration({name: JointCalibration(i, 0, 0, 900, 3200) for i, name in enumerate(SO101, 1)})
    paths = [save_calibration(calibration, folder / f"{each}.json") for each in ("follower", "leader")]
    person = Person([(arms[0], calibration, {}), (arms[1], calibration, off)])
    same = compare_arms(person, arms[0].port, arms[1].port, str(paths[0]), str(paths[1]), yes=True)
    return same, person


def verdicts(person: Person) -> dict[str, str]:
    return {row[0]: row[-1] for row in person.tables[-1]}


def test_arms_that_agree_pass(arms, tmp_path):
    same, person = compared(arms, tmp_path)
    assert same
    assert set(verdicts(person).values()) == {"ok", "not compared"}
    assert [text for text in person.said if text.startswith("Put both")] == [
        f"Put both arms into the same pose: {pose}." for pose in POSES
    ]
    assert person.said[-1] == "6 joints compared in 3 poses: none fails"


@pytest.mark.parametrize(
    ("degrees", "verdict"), [(2.5, "ok"), (3.5, "warn"), (-7.5, "warn"), (8.5, "FAIL"), (17, "FAIL")]
)
def test_zero_that_is_off_is_measured(arms, tmp_path, degrees, verdict):
    same, person = compared(arms, tmp_path, elbow_flex=degrees)
    assert same == (verdict != "FAIL")
    assert {name for name, each in verdicts(person).items() if each == verdict} >= {"elbow_flex"}
    if verdict != "ok":
        (said,) = [each for each in person.said if each.startswith("elbow_flex: the zeros are")]
        assert float(said.split()[4]) == pytest.approx(degrees, abs=0.15)
        assert "(warns from 3, fails from 8): look at the horns" in said


def test_reversed_joint_is_named(arms, tmp_path):
    same, person = compared(arms, tmp_path, shoulder_pan=math.nan)
    assert not same
    assert any(
        each.startswith("shoulder_pan: as the follower turned by 90 deg, the leader turned the other")
        for each in person.said
    )


def test_gripper_of_a_leader_is_not_compared(arms, tmp_path):
    same, _ = compared(arms, tmp_path, gripper=30.0)
    assert same


def test_one_calibration_for_both_is_refused(arms, tmp_path):
    with pytest.raises(CalibrationError):
        compare_arms(FakeGuide(), arms[0].port, arms[1].port, str(tmp_path / "no.json"), str(tmp_path / "no.json"))
    calibration = Calibration({name: JointCalibration(i, 0, 0, 900, 3200) for i, name in enumerate(SO101, 1)})
    path = str(save_calibration(calibration, tmp_path / "one.json"))
    with pytest.raises(HardwareError, match="is the calibration of both arms"):
        compare_arms(FakeGuide(), arms[0].port, arms[1].port, path, path)

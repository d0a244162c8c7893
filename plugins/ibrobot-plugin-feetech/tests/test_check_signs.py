"""`feetech check --check-signs`: a person turns each joint in its positive direction, and reversed ones are named."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import override

import attrs
import pytest
from ibrobot_calibration import Calibration
from ibrobot_feetech.calibration import save_calibration
from ibrobot_feetech.commands.check import check_arm
from ibrobot_feetech.emulator import Emulator
from ibrobot_terminal.fakes import FakeGuide
from ibrobot_terminal.questions import Declined

from .conftest import JOINTS, arm_calibration, prepare
from .line import Line

TURN = 60
"""By how much a joint is turned [ticks]."""


class Person(FakeGuide):
    """Turns the joints that the command names, in the direction that is positive for the arm."""

    def __init__(self, arm: Emulator, calibration: Calibration) -> None:
        super().__init__()
        self.arm = arm
        self.calibration = calibration
        self.clumsy: list[int] = []
        """Ticks of first attempts."""
        self.loose: list[bool] = []
        """Whether the torque of the joint that was turned was off."""

    @override
    def wait(self, request: str, **more: object) -> None:
        self.said.append(request)
        name = next(each for each in JOINTS if f"Turn {each} " in request)
        joint = self.calibration.joints[name]
        servo = self.arm.servos[joint.id]
        self.loose.append(not servo.torque)
        by = self.clumsy.pop(0) if self.clumsy else TURN * (-1 if joint.inverted else 1)
        servo.turn((servo.encoder + by) % 4096)


@pytest.fixture
def arm(lines: None) -> Iterator[Line]:
    with Line(6) as arm:
        prepare(arm, arm_calibration())
        for servo in arm.servos.values():
            servo.set("torque_enable", 1)
        yield arm


def reversed_in(calibration: Calibration, *names: str) -> Calibration:
    """A calibration in which joints have the other direction."""
    joints = {
        name: attrs.evolve(joint, drive_mode=1 - joint.drive_mode) if name in names else joint
        for name, joint in calibration.joints.items()
    }
    return attrs.evolve(calibration, joints=joints)


def checked(arm: Line, folder: Path, *names: str, clumsy: tuple[int, ...] = ()) -> tuple[bool, Person]:
    """Whether the arm matches a file in which joints are reversed."""
    file = save_calibration(reversed_in(arm_calibration(), *names), folder / "arm.json")
    person = Person(arm, arm_calibration())
    person.clumsy += clumsy
    return check_arm(person, arm.port, str(file), signs=True), person


def named(person: Person) -> list[str]:
    return [text.split()[1].rstrip(":") for text in person.said if "it is reversed" in text]


def test_an_arm_with_right_directions_passes(arm: Line, tmp_path: Path) -> None:
    same, person = checked(arm, tmp_path)
    assert same
    assert not named(person)
    assert person.loose == [True] * 6, "the torque is off before a joint is to be turned"
    assert person.said[-1] == "6 servos as in the calibration"


@pytest.mark.parametrize("joint", JOINTS)
def test_each_reversed_joint_is_named(arm: Line, tmp_path: Path, joint: str) -> None:
    same, person = checked(arm, tmp_path, joint)
    assert not same
    assert named(person) == [joint]
    (text,) = [each for each in person.said if "it is reversed" in each]
    turned, stored = (
        ("-60", "0 in the file means more") if joint == "elbow_flex" else ("+60", "1 in the file means fewer")
    )
    assert f"it turned by {turned} ticks in its positive direction, and drive_mode {stored}" in text
    assert "`ibrobot feetech calibrate` with --check-signs" in text


def test_several_reversed_joints_are_all_named(arm: Line, tmp_path: Path) -> None:
    same, person = checked(arm, tmp_path, "shoulder_pan", "wrist_roll", "gripper")
    assert not same
    assert named(person) == ["shoulder_pan", "wrist_roll", "gripper"]


def test_a_joint_that_was_hardly_turned_is_asked_again(arm: Line, tmp_path: Path) -> None:
    same, person = checked(arm, tmp_path, clumsy=(0, -3))
    assert same
    assert sum("Turn shoulder_pan" in text for text in person.said) == 3
    assert "error: shoulder_pan moved by -3 ticks, and must move by" in " ".join(person.said)


def test_a_joint_that_passes_the_end_of_the_encoder_is_not_reversed(arm: Line, tmp_path: Path) -> None:
    """From 4090 to 20 are 26 ticks more, and not 4070 fewer."""
    servo = arm.servos[1]
    servo.set("torque_enable", 0)
    servo.turn((4090 + arm_calibration().joints["shoulder_pan"].homing_offset) % 4096)
    same, person = checked(arm, tmp_path)
    assert same
    assert not named(person)


class Cautious(Person):
    """Does not let the torque be switched off."""

    @override
    def confirm(self, question: str, *, flag: str = "", default: bool = False) -> bool:
        self.said.append(question)
        return False


def test_nothing_is_switched_off_unasked(arm: Line, tmp_path: Path) -> None:
    file = save_calibration(arm_calibration(), tmp_path / "arm.json")
    person = Cautious(arm, arm_calibration())
    with pytest.raises(Declined):
        check_arm(person, arm.port, str(file), signs=True)
    assert all(servo.torque for servo in arm.servos.values())
    assert not person.loose

"""LeRobot's units and calibration files, by LeRobot's own code."""

from __future__ import annotations

from pathlib import Path

import attrs
import draccus
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ibrobot_calibration import Calibration, JointCalibration, load_calibration
from ibrobot_calibration.joint_units import LEROBOT_MODES, lerobot_to_radians, radians_to_lerobot
from ibrobot_feetech.calibration import save_calibration
from lerobot.motors import Motor, MotorCalibration, MotorNormMode
from lerobot.motors.feetech import FeetechMotorsBus
from lerobot_units import angle, normalised

pytestmark = pytest.mark.lerobot

ids = st.integers(1, 6)
joints = st.builds(
    lambda servo, drive_mode, offset, ends: JointCalibration(servo, drive_mode, offset, *sorted(ends)),
    ids,
    st.integers(0, 1),
    st.integers(-2047, 2047),
    st.sets(st.integers(0, 4095), min_size=2, max_size=2),
)


def bus_of(mode: str, joint: JointCalibration) -> FeetechMotorsBus:
    """LeRobot's bus with one motor; its port is never opened."""
    theirs = MotorCalibration(joint.id, joint.drive_mode, joint.homing_offset, joint.range_min, joint.range_max)
    return FeetechMotorsBus("/dev/null", {"pan": Motor(joint.id, "sts3215", MotorNormMode(mode))}, {"pan": theirs})


def test_lerobots_modes_are_ours() -> None:
    assert {mode.value for mode in MotorNormMode} == set(LEROBOT_MODES)


@given(st.sampled_from(LEROBOT_MODES), joints, st.integers(0, 4095))
def test_angles_normalise_as_the_ticks_of_lerobot(mode: str, joint: JointCalibration, ticks: int) -> None:
    theirs = bus_of(mode, joint)._normalize({joint.id: ticks})[joint.id]
    assert normalised(ticks, mode, joint) == theirs, "the formulas that core's tests use"
    ours = radians_to_lerobot(angle(ticks, joint), mode, *joint.ends(), joint.inverted)
    assert ours == pytest.approx(theirs, abs=1e-7)


@given(st.sampled_from(LEROBOT_MODES), joints, st.floats(-200, 200))
def test_values_become_angles_of_lerobots_ticks(mode: str, joint: JointCalibration, value: float) -> None:
    theirs = bus_of(mode, joint)._unnormalize({joint.id: value})[joint.id]  # it truncates ticks
    ours = lerobot_to_radians(value, mode, *joint.ends(), joint.inverted)
    assert ours == pytest.approx(angle(theirs, joint), abs=2 * np.pi / 4096 + 1e-9)


@given(joints)
def test_lerobot_loads_what_we_save(tmp_path_factory: pytest.TempPathFactory, joint: JointCalibration) -> None:
    path = save_calibration(Calibration({"pan": joint}, robot="left"), tmp_path_factory.mktemp("c") / "arm.json")
    with path.open() as file, draccus.config_type("json"):
        theirs = draccus.load(dict[str, MotorCalibration], file)
    assert vars(theirs["pan"]) == {name: getattr(joint, name) for name in vars(theirs["pan"])}


@given(joints)
def test_we_load_what_lerobot_saves(tmp_path_factory: pytest.TempPathFactory, joint: JointCalibration) -> None:
    path: Path = tmp_path_factory.mktemp("c") / "arm.json"
    with path.open("w") as file, draccus.config_type("json"):
        draccus.dump(bus_of("degrees", joint).calibration, file, indent=4)
    assert load_calibration(path).joints == {"pan": attrs.evolve(joint, zero_at="range")}


@given(joints, st.integers(0, 4095))
def test_angles_of_lerobots_file_are_its_degrees(
    tmp_path_factory: pytest.TempPathFactory, joint: JointCalibration, ticks: int
) -> None:
    path: Path = tmp_path_factory.mktemp("c") / "arm.json"
    with path.open("w") as file, draccus.config_type("json"):
        draccus.dump(bus_of("degrees", joint).calibration, file, indent=4)
    loaded = load_calibration(path).joints["pan"]
    # LeRobot divides a turn by 4095, not 4096, and does not turn inverted joints round.
    degrees = bus_of("degrees", joint)._normalize({joint.id: ticks})[joint.id] * 4095 / 4096
    assert np.degrees(angle(ticks, loaded)) == pytest.approx(-degrees if joint.inverted else degrees, abs=1e-9)

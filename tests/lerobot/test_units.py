"""LeRobot's units and calibration files, by LeRobot's own code."""

from __future__ import annotations

from pathlib import Path

import attrs
import draccus
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ibrobot_feetech.calibration import save_calibration
from lerobot.motors import Motor, MotorCalibration, MotorNormMode
from lerobot.motors.feetech import FeetechMotorsBus

from ibrobot_core.calibration import Calibration, JointCalibration, load_calibration
from ibrobot_core.units import LEROBOT_MODES, lerobot_to_ticks, ticks_to_lerobot, ticks_to_radians

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
def test_ticks_normalise_as_in_lerobot(mode: str, joint: JointCalibration, ticks: int) -> None:
    ours = ticks_to_lerobot(ticks, mode, range_min=joint.range_min, range_max=joint.range_max, inverted=joint.inverted)
    assert ours == bus_of(mode, joint)._normalize({joint.id: ticks})[joint.id]


@given(st.sampled_from(LEROBOT_MODES), joints, st.floats(-200, 200))
def test_values_become_lerobots_ticks(mode: str, joint: JointCalibration, value: float) -> None:
    ours = lerobot_to_ticks(value, mode, range_min=joint.range_min, range_max=joint.range_max, inverted=joint.inverted)
    assert int(ours) == bus_of(mode, joint)._unnormalize({joint.id: value})[joint.id]


@given(st.sampled_from(LEROBOT_MODES), joints, st.lists(st.integers(0, 4095), min_size=1))
def test_arrays_normalise_as_each_of_their_elements(mode: str, joint: JointCalibration, ticks: list[int]) -> None:
    bus = bus_of(mode, joint)
    ours = ticks_to_lerobot(
        np.array(ticks), mode, range_min=joint.range_min, range_max=joint.range_max, inverted=joint.inverted
    )
    np.testing.assert_array_equal(ours, [bus._normalize({joint.id: tick})[joint.id] for tick in ticks])


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
    angle = ticks_to_radians(float(ticks), zero=loaded.zero(), inverted=loaded.inverted)
    assert np.degrees(angle) == pytest.approx(-degrees if joint.inverted else degrees, abs=1e-9)

"""A model in LeRobot's units within a run: by the calibration that it names, or the hardware's, or not at all."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from calibration_files import write_calibration
from fake_runs import PLUGINS
from ibrobot_calibration import Calibration, JointCalibration
from ibrobot_calibration.joint_units import radians_to_lerobot, recorded_units

from ibrobot_core.api import Contract, Frame, IbrobotError
from ibrobot_core.app import ComponentFailed

if TYPE_CHECKING:
    from fake_runs import Runs


RANGE = (1000, 3000)
"""Ticks."""


@pytest.fixture
def calibration(tmp_path: Path) -> str:
    joints = {joint: JointCalibration(i, 0, 0, *RANGE) for i, joint in enumerate(("pan", "grip"), 1)}
    return str(write_calibration(Calibration(joints), tmp_path / "arm.json"))


def degrees(positions: Any) -> list[float]:
    """Radians -> LeRobot's degrees by the calibration."""
    ends = JointCalibration(1, 0, 0, *RANGE).ends()
    return [float(radians_to_lerobot(each, "degrees", *ends, False)) for each in positions]


def test_the_model_lives_in_degrees_and_the_arm_in_radians(
    runs: Runs, calibration: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    runtime = runs.make("models.net.norm_mode=degrees", f"models.net.calibration={calibration}")
    seen = []
    real = runs.parts.Net.preprocess

    def preprocess(self: Any, frame: Frame) -> Any:
        seen.append(frame.values["observation.state"])
        return real(self, frame)

    monkeypatch.setattr(runs.parts.Net, "preprocess", preprocess)
    runtime.start()
    session = runtime.session
    begun = session.measured().position.copy()
    for _ in range(24):  # the scene's episode is over after half a second
        runtime.step()
    assert degrees([0.0]) == pytest.approx([48 * 360 / 4095]), "0 rad is 48 ticks off the middle"
    assert seen[0].tolist() == pytest.approx(degrees(begun), abs=0.1)
    goal = runs.parts.MADE["net"]._goal
    before, after = (np.abs(degrees(at) - goal) for at in (begun, session.measured().position))
    assert (after < before / 2).all(), "it moves to the goal, which is in degrees"


def test_no_run_without_a_calibration(runs: Runs) -> None:
    with pytest.raises(ComponentFailed, match="degrees needs the calibration of joint 'pan'; there is none"):
        runs.start("models.net.norm_mode=degrees")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            ("norm_mode=degrees",),
            r"name the type of the units: several .* a default: calibrated \(ibrobot-calibration\), other_units \(",
        ),
        (("norm_mode=degrees", "units=other_unit"), r"unknown units type 'other_unit'.*did you mean 'other_units'"),
        (("norm_mode=degrees", "units=calibrated"), "degrees needs the calibration of joint 'pan'; there is none"),
        (("units=other_units",), "norm_mode is radians, must be degrees"),
    ],
)
def test_units_of_two_plugins_stand_beside_each_other_and_a_model_names_its_own(
    runs: Runs, options: tuple[str, ...], message: str
) -> None:
    runs.site.add("other-units", PLUGINS / "other_units.py")
    with pytest.raises(ComponentFailed, match=message):
        runs.start(*(f"models.net.{each}" for each in options))


def test_units_that_a_model_names_are_used(runs: Runs) -> None:
    runs.site.add("other-units", PLUGINS / "other_units.py")
    runtime = runs.start("models.net.norm_mode=degrees", "models.net.units=other_units")
    for _ in range(24):
        runtime.step()
    assert runtime.session.faults == ()


def test_recordings_are_converted_by_the_units_that_are_named(runs: Runs) -> None:
    runs.site.add("other-units", PLUGINS / "other_units.py")
    contract = Contract(30.0, (), ())
    values = {"action": np.array([0.0, np.pi])}
    plain = recorded_units(None, "radians", contract, {}, {})
    assert plain(values)["action"].tolist() == [0.0, np.pi]
    other = recorded_units("other_units", "degrees", contract, {}, {})
    assert other(values)["action"].tolist() == [0.0, 180.0]
    with pytest.raises(IbrobotError, match=r"name the type of the units: several .* a default"):
        recorded_units(None, "degrees", contract, {}, {})
    with pytest.raises(IbrobotError, match="'units_of_runs' convert the vectors of runs, not of recordings"):
        recorded_units("units_of_runs", "degrees", contract, {}, {})
    with pytest.raises(IbrobotError, match=r"unknown units type 'other_unit'.*did you mean 'other_units'"):
        recorded_units("other_unit", "degrees", contract, {}, {})

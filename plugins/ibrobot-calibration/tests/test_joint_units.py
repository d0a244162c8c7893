"""Units of an arm from another maker: which joints are anchored, and its calibration, are what its descriptor says."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import pytest
from calibration_files import write_calibration
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from ibrobot_calibration import Calibration, JointCalibration
from ibrobot_calibration.joint_units import JointUnits, calibrations, with_closed_ends

from ibrobot_core.api import CalibrationError, Contract, HardwareDescriptor, Options, option
from ibrobot_core.app import RobotConfig, load_config
from ibrobot_core.plugins import Entry, discover

ROBOT = """
robot:
  name: foreign
  joints:
    - {{name: pan, lower: -1.5, upper: 1.5, max_velocity: 3, max_acceleration: 20}}
    - {{name: gripper, lower: -1.0, upper: 1.0, max_velocity: 3, max_acceleration: 20}}
  groups: {{all: [pan, gripper]}}
{section}: {{type: foreign_arm, offsets: {offsets}, closes: [{closes}]}}
executors: {{all: {{type: position, group: all}}}}
control_modes: {{jog: {{executors: [all], teleop: stick}}}}
default_control_mode: jog
teleoperation: {{stick: {{type: stick}}}}
contract:
  rate_hz: 30
  observations:
    - {{key: observation.state, topic: /joint_states, select: [position.pan, position.gripper]}}
  actions: [{{executor: all, topic: /all/commands}}]
"""
MADE = Calibration(
    {
        name: JointCalibration(id=i, drive_mode=0, homing_offset=0, range_min=1000, range_max=3000)
        for i, name in enumerate(("pan", "gripper"), 1)
    }
)
ANGLE = 0.1


@attrs.frozen
class ForeignOptions(Options):
    offsets: str = option(help="file with what other arms call a calibration")
    closes: tuple[str, ...] = option((), help="joints that are closed at their lower limit")

    @property
    def calibration(self) -> str:
        return self.offsets

    @property
    def anchored(self) -> tuple[str, ...]:
        return self.closes


def never_made(options: Any, ctx: Any) -> Any:
    """The `make` of descriptors whose objects no test makes."""


@pytest.fixture
def foreign(tmp_path: Path) -> Callable[[str], RobotConfig]:
    """Loads the arm with some joints that are closed at their lower limit."""
    registry = discover([])
    described = (
        HardwareDescriptor(
            "foreign_arm",
            never_made,
            "an arm",
            ForeignOptions,
        ),
        HardwareDescriptor("stick", never_made, "a stick"),
    )
    for kind, descriptor in zip(("hardware", "teleop"), described, strict=True):
        registry.entries[kind, descriptor.type] = Entry(kind, descriptor, "test", "test", "0")
    offsets = write_calibration(MADE, tmp_path / "offsets.json")

    def config(closes: str) -> RobotConfig:
        path = tmp_path / "robot.yaml"
        path.write_text(ROBOT.format(section="hardware", offsets=offsets, closes=closes))
        return load_config(path, registry=registry)

    return config


def shown(config: RobotConfig, norm_mode: str, numbers: Any = None) -> list[float]:
    """`ANGLE` of both joints in a unit, by what a recording of the robot keeps."""
    (kept,) = calibrations(config).values() if numbers is None else (numbers,)
    recorded = json.loads(json.dumps([kept, config.document], default=str))
    units = JointUnits(norm_mode, Contract.from_config(config), *recorded)
    return units({"action": np.full(2, ANGLE)})["action"].tolist()


def test_joint_called_gripper_is_anchored_only_where_the_hardware_says_so(foreign: Callable[[str], RobotConfig]):
    pan, gripper = shown(foreign(""), "degrees")
    assert gripper == pytest.approx(pan, abs=1e-9), "both are arm joints in degrees"
    assert gripper == pytest.approx(np.degrees(ANGLE), abs=8.5)  # the range's middle is 48 ticks from the encoder's


def test_joint_of_any_name_is_anchored_where_the_hardware_says_so(foreign: Callable[[str], RobotConfig]):
    pan, gripper = shown(foreign("pan"), "range_m100_100")
    turn = 4096 / (2 * np.pi)
    assert pan == pytest.approx((ANGLE + 1.5) * turn / 2000 * 100, abs=0.1), "0 at its lower limit, up to 100"
    assert gripper == pytest.approx((2047 + ANGLE * turn - 2000) / 1000 * 100, abs=0.2)


def test_calibration_from_elsewhere_takes_the_closed_ends_of_the_robot(foreign: Callable[[str], RobotConfig]):
    config = foreign("pan")
    assert shown(config, "degrees", with_closed_ends(MADE.numbers(), config)) == shown(config, "degrees")


def test_recording_without_closed_ends_reads_as_before(foreign: Callable[[str], RobotConfig]):
    config = foreign("")
    document = {**config.document, "hardware": {"type": "feetech_so101"}}
    before = JointUnits("degrees", Contract.from_config(config), MADE.snapshot(), document)
    named = JointUnits(
        "degrees", Contract.from_config(config), with_closed_ends(MADE.snapshot(), foreign("gripper")), {}
    )
    values = {"action": np.full(2, ANGLE)}
    np.testing.assert_array_equal(before(values)["action"], named(values)["action"])


def _stated(config: RobotConfig, anchored: set[str] | None) -> dict[str, dict[str, Any]]:
    if anchored is None:
        return with_closed_ends(MADE.snapshot(), config)
    ends = {"pan": -1.5, "gripper": -1.0}
    return {
        joint: {**numbers, "closed_at": ends[joint] if joint in anchored else None}
        for joint, numbers in MADE.snapshot().items()
    }


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    mode=st.sampled_from(("degrees", "range_m100_100")),
    hardware=st.booleans(),
    anchored=st.none() | st.sets(st.sampled_from(("pan", "gripper"))),
    percent=st.floats(0, 100),
)
def test_no_gripper_is_read_in_a_unit_that_nothing_states(
    foreign: Callable[[str], RobotConfig], mode: str, hardware: bool, anchored: set[str] | None, percent: float
):
    """200 datasets of a robot with and without hardware: what is anchored is from 0 to 100, or it is asked for."""
    config = foreign("gripper")
    document = dict(config.document) if hardware else {**config.document, "hardware": None}
    if not hardware:
        config = attrs.evolve(config, closed_ends={})
    calibration = _stated(config, anchored)
    if not hardware and anchored is None:
        with pytest.raises(CalibrationError, match=rf"{mode}: does joint 'pan' range from 0 .*--anchored gripper"):
            JointUnits(mode, Contract.from_config(config), calibration, document)
        return
    units = JointUnits(mode, Contract.from_config(config), calibration, document)
    pan, gripper = units.radians("action", np.full(2, percent))
    closed = {"gripper"} if anchored is None else anchored
    for joint, found, lower in (("pan", pan, -1.5), ("gripper", gripper, -1.0)):
        width = 2000 / 4096 * 2 * np.pi
        if joint in closed:
            expected = lower + percent / 100 * width
        elif mode == "degrees":
            expected = np.radians(percent) * 4095 / 4096 + (2000 - 2048) / 4096 * 2 * np.pi
        else:
            expected = (percent + 100) / 200 * width + (1000 - 2048) / 4096 * 2 * np.pi
        assert found == pytest.approx(expected, abs=5e-3)

"""A policy in LeRobot's units behind a contract in radians."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, override

import attrs
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ibrobot_calibration import ZERO_AT, Calibration, JointCalibration
from ibrobot_calibration.joint_units import JointUnits, radians_to_lerobot
from ibrobot_testing.contexts import host_context
from lerobot_units import angle, normalised
from numpy.typing import NDArray

from ibrobot_core.api import (
    ActionPart,
    CalibrationError,
    Contract,
    Feature,
    Frame,
    ObservationPart,
    Policy,
    PolicySpec,
    Tensors,
)
from ibrobot_core.app import Align

JOINTS = host_context().robot.joint_names
CALIBRATION: dict[str, dict[str, Any]] = {
    joint: {"id": i + 1, "drive_mode": i % 2, "homing_offset": 0, "range_min": 700 + 10 * i, "range_max": 3300 - 20 * i}
    for i, joint in enumerate(JOINTS)
}
DOCUMENT = {"hardware": {"type": "arm"}, "robot": {"joints": [{"name": joint, "lower": -0.2} for joint in JOINTS]}}
CONTRACT = Contract(
    30.0,
    (
        ObservationPart(
            "observation.state",
            "/joint_states",
            "sensor_msgs/msg/JointState",
            tuple(f"position.{joint}" for joint in JOINTS),
            None,
            Align(),
            Feature("float32", (len(JOINTS),)),
        ),
    ),
    (ActionPart("arm", "/commands", "std_msgs/msg/Float64MultiArray", "hold", JOINTS),),
)


def units(norm_mode: str, calibration: Mapping[str, Mapping[str, Any]] = CALIBRATION) -> JointUnits:
    return JointUnits(norm_mode, CONTRACT, calibration, DOCUMENT)


class Echo(Policy):
    """Gives back what it sees: the prefix, the history, the state."""

    spec = PolicySpec({"observation.state": (len(JOINTS),)}, None, len(JOINTS), 10, prefix=True, history=1)

    @override
    def preprocess(self, frame: Frame) -> Tensors:
        rows: list[NDArray[Any]] = [] if frame.prefix is None else [frame.prefix]
        rows += [each.values["observation.state"][None] for each in (*frame.history, frame)]
        return {"rows": np.concatenate(rows).astype(np.float64)}

    @override
    def infer(self, tensors: Tensors) -> Tensors:
        return tensors

    @override
    def postprocess(self, tensors: Tensors) -> NDArray[np.float64]:
        return np.asarray(tensors["rows"], np.float64)


def frame(seed: int = 0) -> Frame:
    rng = np.random.default_rng(seed)
    state = rng.uniform(-0.15, 0.9, (2, len(JOINTS))).astype(np.float32)
    past = Frame(0, {"observation.state": state[0], "observation.force": state[1]})
    here = attrs.evolve(past, values={**past.values, "observation.state": state[1]}, history=(past,))
    return attrs.evolve(here, prefix=rng.uniform(-0.15, 0.9, (3, len(JOINTS))))


@pytest.mark.parametrize("norm_mode", ["degrees", "range_m100_100"])
def test_it_sees_its_unit_and_gives_radians(norm_mode: str) -> None:
    policy, converted = Echo(), units(norm_mode)
    shown = frame()
    seen = policy.preprocess(converted.frame(shown))["rows"]
    arm = JointCalibration(**CALIBRATION["shoulder_lift"])
    lift = radians_to_lerobot(shown.values["observation.state"][1], norm_mode, *arm.ends(), arm.inverted)
    assert abs(seen[-1, 1] - lift) < 1e-4
    assert abs(lift) > 2  # neither radians nor normalised twice
    assert shown.prefix is not None
    wanted = [*shown.prefix, shown.history[0].values["observation.state"], shown.values["observation.state"]]
    np.testing.assert_allclose(converted.radians("action", policy.postprocess({"rows": seen})), wanted, atol=1e-6)


def test_a_gripper_is_0_at_its_closed_end_in_both_units() -> None:
    closed = np.full((1, len(JOINTS)), -0.2)
    for norm_mode in ("degrees", "range_m100_100"):
        assert abs(units(norm_mode)({"action": closed})["action"][0, -1] % 100) < 1e-9


def test_radians_are_passed_through() -> None:
    values = {"action": np.ones((1, len(JOINTS)))}
    assert units("radians")(values)["action"] is values["action"]
    assert units("radians").radians("action", values["action"]) is values["action"]


@given(
    st.tuples(st.integers(0, 1000), st.integers(3000, 4095), st.integers(0, 1), st.sampled_from(sorted(ZERO_AT))),
    st.integers(0, 4095),
)
def test_what_a_dataset_gets_is_lerobots_value_of_the_tick_wherever_0_rad_is(
    numbers: tuple[int, int, int, str], ticks: int
) -> None:
    low, high, drive_mode, zero_at = numbers
    arm = Calibration(
        {joint: JointCalibration(i, drive_mode, 0, low, high, zero_at) for i, joint in enumerate(JOINTS, 1)}
    )
    pan = arm.joints[JOINTS[0]]
    measured = np.full(len(JOINTS), angle(ticks, pan))
    for mode in ("degrees", "range_m100_100"):
        # The state in float64, as the recorded calibration says: the same for either place of 0 rad.
        (value, *_) = units(mode, arm.snapshot())({"action": measured})["action"]
        assert value == pytest.approx(normalised(ticks, mode, pan), abs=1e-9)


def test_no_unit_without_a_calibration() -> None:
    with pytest.raises(CalibrationError, match="degrees needs the calibration of joint 'shoulder_pan'; there is none"):
        units("degrees", {})
    some = {joint: numbers for joint, numbers in CALIBRATION.items() if joint != "elbow_flex"}
    with pytest.raises(CalibrationError, match="joint 'elbow_flex'; it has: shoulder_pan, shoulder_lift"):
        units("degrees", some)

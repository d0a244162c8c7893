"""Identification of arms with planted parameters, from short recordings."""

from __future__ import annotations

import json
from pathlib import Path

import attrs
import numpy as np
import pytest
from arm_moves import TICK_NS, moves
from ibrobot_mujoco.hardware import MujocoHardware
from ibrobot_mujoco.identification.contents import contents_of, lines_of, read_contents, write_report
from ibrobot_mujoco.identification.findings import findings_of
from ibrobot_mujoco.identification.fit import ARM, refit
from ibrobot_mujoco.identification.identify import Result, identify
from ibrobot_mujoco.identification.simulation import FedArm
from ibrobot_mujoco.options import MujocoOptions
from ibrobot_mujoco.parameters import JointParameters, read_parameters
from ibrobot_mujoco.scenes import scene
from ibrobot_testing import control_context

from ibrobot_core.api import DatasetError, EpisodeSetup, Vector

from .planted_arm import PUBLISHED, ROBOT, STEP_S, planted, recorded, simulated

PLANTED = planted(
    0.024, every={"damping": 0.8, "frictionloss": 0.08, "kp": 11.0},
    elbow_flex={"kp": 4.5}, wrist_roll={"backlash": 0.04}, shoulder_pan={"bias": 0.02},
)  # fmt: skip
"""The elbow is weak, and the wrist has backlash."""
OPTIONS = MujocoOptions(timestep=STEP_S)


def identified(parameters: object, folder: Path, commands: Vector, **more: object) -> Result:
    recording = recorded(simulated(parameters, folder), commands)  # type: ignore[arg-type]
    return identify(OPTIONS, ROBOT, [recording], **more)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Result:
    """Of 24 s."""
    return identified(PLANTED, tmp_path_factory.mktemp("planted"), moves(24.0))


def test_planted_parameters_are_recovered(result: Result) -> None:
    found = result.parameters
    assert found.delay == pytest.approx(PLANTED.delay, rel=0.1)
    for name, each in PLANTED.joints.items():
        joint = found.joints[name]
        assert joint.kp == pytest.approx(each.kp, rel=0.1), name
        assert joint.damping == pytest.approx(each.damping, rel=0.1), name
        assert joint.backlash == pytest.approx(each.backlash, abs=0.006), name
        assert joint.bias == pytest.approx(each.bias, abs=0.006), name
        # Friction and backlash both lose motion: the encoder does not show which of them loses a quarter of a degree.
        assert lost_motion(joint) == pytest.approx(lost_motion(each), rel=0.1), name


def lost_motion(joint: JointParameters) -> float:
    """How far a command moves before the joint does, when it reverses [rad]."""
    return joint.backlash + 2 * joint.frictionloss / joint.kp


def test_what_is_called_known_is_within_a_tenth_or_its_least_deviation(result: Result) -> None:
    called = [each for each in result.fitted.known if each.confidence == "known"]
    assert len(called) > 20
    for each in called:
        truth = getattr(PLANTED if each.joint == ARM else PLANTED.joints[each.joint], each.name) or 0.0
        assert abs(each.value - truth) <= max(0.1 * abs(truth), 2 * each.kind.enough), (each.joint, each.name)


def test_held_out_error_falls(result: Result) -> None:
    totals = {name: np.rad2deg(value) for name, value in result.totals.items()}
    assert totals["after"] < 0.2
    assert totals["after"] < 0.2 * totals["before"]
    assert totals["after"] < 0.5 * totals["delay_lag_bias"]


def test_weak_joint_and_backlash_are_named(result: Result) -> None:
    kinds = {(each.kind, each.joint) for each in result.findings}
    assert {("weak", "elbow_flex"), ("backlash", "wrist_roll"), ("delay", ARM)} <= kinds
    assert not {joint for kind, joint in kinds if kind in ("weak", "stiff", "drift")} - {"elbow_flex"}
    assert "elbow_flex is weaker than the others" in "\n".join(result.lines())


def test_torque_limit_that_was_never_reached_is_unknown(result: Result) -> None:
    assert result.fitted.of("gripper", "torque_limit").confidence == "unknown"
    what, how = next(each for each in result.unknown if each[0].startswith("torque_limit"))
    assert "gripper" in what
    assert "lift a known weight" in how
    assert result.fitted.of("shoulder_lift", "kp").confidence == "known"


def test_file_of_parameters_and_report_are_written(result: Result, tmp_path: Path) -> None:
    write_report(tmp_path, result.facts(), result.parameters)
    read = read_parameters(tmp_path / "parameters.yaml", ROBOT)
    assert read.joints["elbow_flex"].kp == pytest.approx(4.5, rel=0.1)
    assert read.identified.deviations["elbow_flex"]["kp"] > 0
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert page.count("<svg") == 2 + len(ROBOT.joints)
    assert "http" not in page.replace("http-equiv", "")
    assert "elbow_flex is weaker" in page
    assert lines_of(tmp_path) == result.lines()[:3]
    assert contents_of(result.facts()) == read_contents(tmp_path)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"lines": ["a"]}', '{"lines": 3}'])
def test_damaged_report_is_named(text: str, tmp_path: Path) -> None:
    (tmp_path / "identification.json").write_text(text)
    with pytest.raises(DatasetError, match=r"identification\.json: "):
        read_contents(tmp_path)


def test_a_number_without_bounds_in_a_report_is_named(tmp_path: Path) -> None:
    """It cannot be drawn."""
    names = ("before", "delay_lag_bias", "after")
    course = {"joints": ["pan"], "times": [0.0, 0.1], **{each: [[0.0], [0.1]] for each in ("command", "measured")}}
    facts = {
        "robot": "arm", "seconds": 60.0, "lines": ["It is good."], "unknown": [], "parameters": [],
        "held_out_rms_deg": dict.fromkeys(names, 1.0), "course": course | {"before": [[0.0]], "after": [[0.0]]},
        "held_out_rms_deg_by_joint": {name: {"pan": float("inf")} for name in names},
    }  # fmt: skip
    (tmp_path / "identification.json").write_text(json.dumps(facts))
    with pytest.raises(DatasetError, match=r"identification\.json: is not an identification: OverflowError"):
        read_contents(tmp_path)


def test_drift_since_the_last_time_is_named(result: Result) -> None:
    last = result.parameters
    grips = dict.fromkeys(ROBOT.joint_names, False)
    assert not [each for each in findings_of(result.fitted, grips, last) if each.kind == "drift"]
    joints = {**last.joints, "shoulder_lift": attrs.evolve(last.joints["shoulder_lift"], kp=7.0, backlash=0.05)}
    found = findings_of(result.fitted, grips, attrs.evolve(last, joints=joints))
    drifts = {(each.joint, each.text.split()[1]) for each in found if each.kind == "drift"}
    assert drifts == {("shoulder_lift", "kp"), ("shoulder_lift", "backlash")}


def test_stiff_arm_of_the_mjcf_is_simulated_as_it_is_and_has_no_weak_joint(tmp_path: Path) -> None:
    """No file of parameters describes its servos: their damping counts towards the limit of their torque."""
    options = MujocoOptions(scene=scene("empty"), start_pose="home", timestep=STEP_S)
    hardware = MujocoHardware(options, control_context("sim", robot=ROBOT, period_ns=TICK_NS))
    hardware.connect()
    hardware.reset(EpisodeSetup(0))
    stiff = identify(OPTIONS, ROBOT, [recorded(hardware, moves(8.0))])
    assert np.rad2deg(stiff.totals["before"]) < 0.15
    assert stiff.totals["after"] > 2 * stiff.totals["before"]
    assert not [each for each in stiff.findings if each.kind in ("weak", "stiff")]
    said = "\n".join(stiff.lines())
    assert "The identified simulation follows the arm less well than the one before" in said
    assert "the parameters of all joints count as unknown, and are not worth using" in said
    assert {each.confidence for each in stiff.fitted.known if each.joint != ARM} == {"unknown"}


def test_arm_that_rests_tells_nothing(tmp_path: Path) -> None:
    """Without motion, nothing but the sag under gravity is known."""
    resting = identified(PUBLISHED, tmp_path, np.tile(ROBOT.pose("home"), (800, 1)))
    unknown = {(each.joint, each.name) for each in resting.fitted.known if each.confidence == "unknown"}
    assert {(joint, name) for joint in ROBOT.joint_names for name in ("damping", "armature", "torque_limit")} <= unknown
    assert (ARM, "delay") in unknown
    assert any("begin and end motions abruptly" in how for _, how in resting.unknown)


def test_gripper_that_holds_an_object_is_left_out(tmp_path: Path) -> None:
    commands = moves(16.0, seed=3)
    recording = recorded(simulated(PLANTED, tmp_path), commands)
    measured = recording.measured.copy()
    commands[500:1000, 5], measured[500:1000, 5] = 0.2, 0.7  # it closes on something
    spoilt = attrs.evolve(recording, commands=commands, measured=measured)
    held = identify(OPTIONS, ROBOT, [spoilt])
    assert held.fitted.held["gripper"] == pytest.approx(0.31, abs=0.03)
    assert held.parameters.joints["gripper"].kp == pytest.approx(11.0, rel=0.15)
    assert "gripper held something for" in "\n".join(held.lines())


def test_backlash_that_a_fit_took_for_friction_is_found(tmp_path: Path) -> None:
    """Both lose motion, and a fit that began with the wrong one may end there."""
    recording = recorded(simulated(PLANTED, tmp_path), moves(24.0))
    wrist = PLANTED.joints["wrist_roll"]
    stiff = attrs.evolve(wrist, frictionloss=lost_motion(wrist) * wrist.kp / 2, backlash=0.0)
    start = attrs.evolve(PLANTED, joints={**PLANTED.joints, "wrist_roll": stiff})
    arm = FedArm(OPTIONS, ROBOT, 1)
    try:
        fitted = refit(arm, [recording], start, start)
    finally:
        arm.close()
    assert fitted.of("wrist_roll", "backlash").value == pytest.approx(wrist.backlash, abs=0.006)

"""The file of `simulation.parameters`: its format, its errors, and what the simulation makes of it."""

from __future__ import annotations

from pathlib import Path

import attrs
import numpy as np
import pytest
from arm_moves import moves
from hypothesis import given
from hypothesis import strategies as st
from ibrobot_mujoco.identification.simulation import FedArm, with_backlash
from ibrobot_mujoco.model import build_model
from ibrobot_mujoco.options import MujocoOptions
from ibrobot_mujoco.parameters import ArmParameters, Identification, JointParameters, as_yaml, read_parameters
from ibrobot_mujoco.scenes import scene
from ibrobot_mujoco.setpoints import Servos

from ibrobot_core.api import HardwareError
from ibrobot_core.app import ConfigError, load_config

from .planted_arm import PUBLISHED, ROBOT, STEP_S, planted, recorded, simulated

NAMES = ROBOT.joint_names
_positive = st.floats(1e-3, 1e3)
_joint = st.builds(
    JointParameters, kp=_positive, damping=_positive, frictionloss=_positive, armature=_positive,
    torque_limit=st.none() | _positive, backlash=st.floats(0, 1), bias=st.floats(-1, 1),
)  # fmt: skip
_identified = st.builds(
    Identification,
    episodes=st.lists(st.text(st.characters(codec="utf-8", categories=("L", "N", "P", "Z")), max_size=20)).map(tuple),
    seconds=st.floats(0, 1e5), unknown=st.just(("gripper.torque_limit",)),
    held_out_rms=st.dictionaries(st.sampled_from(["before", "after"]), _positive),
    deviations=st.dictionaries(st.sampled_from(NAMES), st.dictionaries(st.just("kp"), _positive)),
)  # fmt: skip
_arm = st.builds(
    ArmParameters, schema=st.just(1), robot=st.just("so101"), delay=st.floats(0, 1),
    gravity_compensation=st.none() | st.floats(-1, 1), joints=st.fixed_dictionaries(dict.fromkeys(NAMES, _joint)),
    identified=_identified,
)  # fmt: skip


@given(_arm)
def test_what_is_written_is_read(tmp_path_factory: pytest.TempPathFactory, parameters: ArmParameters) -> None:
    file = tmp_path_factory.getbasetemp() / "parameters.yaml"
    file.write_text(as_yaml(parameters), encoding="utf-8")
    read = read_parameters(file, ROBOT)
    assert as_yaml(read) == as_yaml(parameters)
    assert read.joints["gripper"].kp == pytest.approx(parameters.joints["gripper"].kp, rel=1e-3)


@given(
    st.text(max_size=200)
    | st.from_regex(r"schema: [0-9.]{1,3}\njoints: \{[a-z_]{1,9}: \{kp: .{1,9}\}\}", fullmatch=True)
)
def test_other_text_is_a_config_error(tmp_path_factory: pytest.TempPathFactory, text: str) -> None:
    file = tmp_path_factory.getbasetemp() / "other.yaml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=r"other\.yaml"):
        read_parameters(file, ROBOT)


GOOD = as_yaml(PUBLISHED)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("schema: 1", "schema: 2", "p.yaml:1: schema: 2 is not one of: 1"),
        ("schema: 1\n", "", "p.yaml: schema: required key is missing"),
        ("  gripper:", "  griper:", "joints.griper: the robot has no such joint, did you mean 'gripper'?"),
        ("kp: 8.902", "kp: -1", "joints.shoulder_pan.kp: "),
        ("kp: 8.902", "kp: .nan", "joints.shoulder_pan.kp: "),
        ("kp: 8.902", "kq: 8.902", "joints.shoulder_pan.kq: unknown key; known keys: kp, damping"),
        ("kp: 8.902", 'kp: "8"', "joints.shoulder_pan.kp: expected a number, got '8'"),
        ("delay: 0.0", "delay: 3", "p.yaml:3: delay: "),
    ],
)
def test_fault_is_named_with_file_line_and_key(old: str, new: str, says: str, tmp_path: Path) -> None:
    assert old in GOOD
    file = tmp_path / "p.yaml"
    file.write_text(GOOD.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(ConfigError) as raised:
        read_parameters(file, ROBOT)
    assert says in str(raised.value)


def test_missing_joint_and_missing_file_are_named(tmp_path: Path) -> None:
    file = tmp_path / "p.yaml"
    few = attrs.evolve(PUBLISHED, joints={"gripper": PUBLISHED.joints["gripper"]})
    file.write_text(as_yaml(few), encoding="utf-8")
    with pytest.raises(ConfigError, match=r"p\.yaml:\d+: joints: shoulder_pan, .*: missing; a file has each"):
        read_parameters(file, ROBOT)
    with pytest.raises(ConfigError, match=r"nowhere\.yaml: cannot be read: No such file"):
        read_parameters(tmp_path / "nowhere.yaml")


def test_robot_yaml_names_the_fault_of_its_file(tmp_path: Path) -> None:
    file = tmp_path / "p.yaml"
    file.write_text(GOOD.replace("kp: 8.902", "kp: -1", 1), encoding="utf-8")
    with pytest.raises(ConfigError, match=r"simulation\.parameters: .*p\.yaml:\d+: joints\.shoulder_pan\.kp"):
        load_config(Path("configs/so101.yaml").absolute(), sim=True, overrides=(f"simulation.parameters={file}",))


def test_file_and_options_of_all_joints_exclude_each_other() -> None:
    with pytest.raises(ValueError, match="parameters and kp exclude each other"):
        MujocoOptions(parameters=Path("p.yaml"), kp=10.0)


def test_model_has_the_parameters(tmp_path: Path) -> None:
    file = tmp_path / "p.yaml"
    wanted = planted(every={"kp": 7.5}, gripper={"torque_limit": 1.25})
    file.write_text(as_yaml(attrs.evolve(wanted, gravity_compensation=0.4)), encoding="utf-8")
    model = build_model(MujocoOptions(parameters=file, scene=scene("empty")), ROBOT, visual=False)
    servo = model.actuator("gripper").id
    assert model.actuator_gainprm[servo, 0] == 7.5
    assert tuple(model.actuator_biasprm[servo, 1:3]) == (-7.5, 0.0)
    assert tuple(model.actuator_forcerange[servo]) == (-1.25, 1.25)
    assert float(np.ravel(model.dof_damping[model.joint("gripper").dofadr[0]])[0]) == pytest.approx(0.608)
    assert model.body_gravcomp[model.body("upper_arm").id] == pytest.approx(0.4)


def test_model_names_the_fault_of_its_file(tmp_path: Path) -> None:
    file = tmp_path / "p.yaml"
    file.write_text("schema: 1\njoints: {}\n", encoding="utf-8")
    with pytest.raises(HardwareError, match="joints is empty"):
        build_model(MujocoOptions(parameters=file), ROBOT, visual=False)


def test_soft_servo_sags_and_delay_is_kept(tmp_path: Path) -> None:
    """The published servo hangs by gravity, and a delayed command moves the arm later by the delay."""
    commands = np.tile(ROBOT.pose("home"), (100, 1))
    commands[50:, 4] = 0.5
    prompt = recorded(simulated(planted(), tmp_path), commands, encoder=0)
    late = recorded(simulated(planted(0.05), tmp_path), commands, encoder=0)
    assert 0.02 < abs(prompt.measured[49, 1]) < 0.25
    np.testing.assert_allclose(late.measured[60:, 4], prompt.measured[55:-5, 4], atol=1e-3)


def test_loaded_joint_at_rest_is_held_by_its_dry_friction(tmp_path: Path) -> None:
    """A command that asks for a third of the dry friction hardly moves a joint; it could move it by 0.03 rad."""
    arm = planted(every={"frictionloss": 0.9, "kp": 10.0})
    commands = np.tile(ROBOT.pose("home"), (300, 1))
    commands[100:, [0, 4]] += 0.03
    measured = recorded(simulated(arm, tmp_path), commands, encoder=0).measured[:, [0, 4]]
    assert np.abs(measured[-1] - measured[100]).max() < 0.008


def test_backlash_is_lost_motion() -> None:
    there_and_back = np.concatenate([np.linspace(0, 0.3, 50), np.linspace(0.3, 0, 50)])[:, None]
    moved = with_backlash(there_and_back, np.array([0.1]))
    assert moved[49, 0] == pytest.approx(0.25)
    assert moved[99, 0] == pytest.approx(0.05)
    servos = Servos(1.0, np.array([0.1]), np.zeros(1))
    np.testing.assert_allclose(servos.steps(there_and_back), moved)


def test_fed_arm_is_the_simulation(tmp_path: Path) -> None:
    """What is fitted is what the simulation does: the same motion, with all parameters at once."""
    parameters = planted(0.02, every={"backlash": 0.02, "bias": 0.01})
    recording = recorded(simulated(parameters, tmp_path), moves(4.0), encoder=0)
    arm = FedArm(MujocoOptions(timestep=STEP_S), ROBOT)
    (reached,) = arm.run(parameters, [recording], np.inf)
    arm.close()
    # At first the arm falls: its speed when the recording begins can only be estimated.
    np.testing.assert_allclose(reached[100:], recording.measured[100:], atol=1e-3)
    assert np.abs(np.diff(recording.measured, axis=0)).max() > 0.01

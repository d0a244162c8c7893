"""Contracts with poses of the tool and relative actions: runs, recordings, conversions and robot YAMLs."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import experts
import numpy as np
import pyarrow.parquet as pq
import pytest
from command_line import run_here
from ibrobot_calibration.joint_units import calibrated_units
from ibrobot_data.ticks import Ticks, frames
from ibrobot_kinematics import robot_model
from ibrobot_kinematics.rotations import log

from ibrobot_core.config import find_config, load_config
from ibrobot_core.contract.frames import FrameAssembler
from ibrobot_core.contract.specs import Contract
from ibrobot_core.errors import ComponentFailed, ConfigError
from ibrobot_core.interfaces.run import LaunchRequest
from ibrobot_core.launch.runtime import Runtime
from ibrobot_core.launch.session import Session
from ibrobot_core.plugins import installed_plugins

pytestmark = [pytest.mark.integration, pytest.mark.usefixtures("first_conversion")]

POSES = "[tool.position, tool.rotation_6d]"
TOOL = f"{{key: observation.tool, topic: /joint_states, select: {POSES[:-1]}, position.gripper]}}"
JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
STATE = "{key: observation.state, topic: /joint_states}"
NAMES = ["ee.x", "ee.y", "ee.z", "ee.r11", "ee.r21", "ee.r31", "ee.r12", "ee.r22", "ee.r32", "gripper.pos"]
DELTAS = f"[{', '.join(f'delta.{joint}' for joint in JOINTS)}]"


@pytest.fixture
def kept(site: Any) -> Iterator[list[Any]]:
    """The frames that the policy `mover` gets."""
    site.add("tool-mover", "tool_mover.py")
    installed_plugins()
    frames_kept: list[Any] = sys.modules["tool_mover"].KEPT
    frames_kept.clear()
    yield frames_kept
    frames_kept.clear()


def overrides(select: str, *more: str, observations: str = f"[{STATE}, {TOOL}]") -> tuple[str, ...]:
    return (f"contract.observations={observations}", f"contract.actions.0.select={select}", *more)


def run(root: Path | None, select: str, model: str = "{type: mover}", duration_s: float = 1.5) -> tuple[Any, Any]:
    """A run of a policy in simulation; its config, and its summary."""
    recording = () if root is None else (f"recording={{type: mcap, root: {root}}}",)
    mode = "control_modes.model_inference.inference.model=mover"
    config = load_config(
        find_config("so101_blind", installed_plugins()),
        overrides=overrides(select, f"models={{mover: {model}}}", mode, *recording),
        sim=True,
    )
    runtime = Runtime(Session(config, installed_plugins(), LaunchRequest(lockstep=True, duration_s=duration_s)))
    runtime.start()
    try:
        while not runtime.step():
            pass
    finally:
        runtime.stop()
    runtime.raise_failure()
    return config, runtime.summary()


def test_poses_that_a_policy_saw_and_gave_are_converted_bit_by_bit(kept: list[Any], tmp_path: Path) -> None:
    config, summary = run(tmp_path, POSES)
    assert len(kept) > 40
    assert summary["unreachable"] == 0
    [path] = (tmp_path / "default/episodes").iterdir()
    reader = installed_plugins().open_episode(path)
    spec = Contract.from_canonical(json.loads(reader.summary().metadata["contract"]))
    assert spec.fingerprint() == Contract.from_config(config).fingerprint()
    messages = ((each.topic, each.message, each.received_ns) for each in reader.messages(spec.topics))
    times = [frame.stamp_ns for frame in kept]
    for live, later in zip(kept, frames(FrameAssembler(spec), messages, times), strict=True):
        for key in ("observation.tool",):
            assert live.values[key].tobytes() == later.values[key].tobytes()
    moved = kept[-1].values["observation.tool"][:3] - kept[0].values["observation.tool"][:3]
    assert np.linalg.norm(moved) > 0.01, "the poses moved the tool"

    assert run_here("convert", str(path), "--out", str(tmp_path / "set")).returncode == 0
    info = json.loads((tmp_path / "set/meta/info.json").read_text())
    assert info["features"]["observation.tool"]["names"] == NAMES
    assert info["features"]["action"]["names"] == NAMES
    [file] = (tmp_path / "set/data").rglob("*.parquet")
    table = pq.read_table(file).to_pydict()
    units = calibrated_units("radians", spec, {}, config.document)
    rows = list(Ticks(reader, spec, "skip"))
    assert len(rows) == len(table["action"]) > 40
    arm = robot_model(config.robot, JOINTS)
    for row, action, tool in zip(rows, table["action"], table["observation.tool"], strict=True):
        assert row["observation.tool"].tobytes() == np.array(tool, np.float32).tobytes()
        assert units(row)["action"].tobytes() == np.array(action, np.float32).tobytes()
        tip = arm.forward(row["action"][:5].astype(float))
        np.testing.assert_allclose(action[:3], tip.position, atol=1e-6)
        np.testing.assert_allclose(action[3:9], tip.rotation.T[:2].ravel(), atol=1e-6)
        assert action[9] == row["action"][5]
    reader.close()


def test_unreachable_poses_are_held_and_counted_in_the_summary(kept: list[Any]) -> None:
    _, summary = run(None, POSES, "{type: mover, far: true}")
    assert summary["unreachable"] == sum(n % 3 == 0 for n in range(1, len(kept) + 1)) > 10
    assert summary["faults"] == []


def test_relative_actions_move_each_joint_from_where_it_is_measured(kept: list[Any], tmp_path: Path) -> None:
    config, _ = run(tmp_path, DELTAS, "{type: mover, deltas: true}", 1.0)
    assert all({"observation.state", "observation.tool"} <= set(frame.values) for frame in kept), (
        "what an action is relative to is sampled though the policy does not read it"
    )
    [path] = (tmp_path / "default/episodes").iterdir()
    reader = installed_plugins().open_episode(path)
    spec = Contract.from_config(config)
    units = calibrated_units("radians", spec, {}, config.document)
    rows = [(row, units(row)) for row in Ticks(reader, spec, "skip")]
    reader.close()
    for row, made in rows:
        wanted = row["action"][:5].astype(float) - row["observation.state"][:5]
        np.testing.assert_allclose(made["action"][:5], wanted, atol=1e-7)
    assert rows[-1][0]["observation.state"][0] > rows[0][0]["observation.state"][0] + 0.02


def test_chunks_of_relative_actions_are_refused_before_anything_moves(kept: list[Any]) -> None:
    with pytest.raises(ComponentFailed, match=r"shoulder_pan\.delta is relative .* chunk of 2"):
        run(None, DELTAS, "{type: mover, deltas: true, chunk_size: 2}")
    assert kept == []


def test_dataset_of_poses_is_not_made_into_commands(kept: list[Any], tmp_path: Path) -> None:
    run(tmp_path, POSES, duration_s=0.5)
    [path] = (tmp_path / "default/episodes").iterdir()
    assert run_here("convert", str(path), "--out", str(tmp_path / "set")).returncode == 0
    back = run_here("convert", f"{tmp_path / 'set'}:0", "--to", "bag", "--out", str(tmp_path / "bags"))
    assert back.returncode != 0
    assert "cannot make" in back.stderr


CHANGES = {
    "no part": ("[tool]", {}, "0.select: 'tool': the tool has no 'tool'"),
    "no joint": ("[delta]", {}, "0.select: expected all joints of the executor in their order"),
    "empty arm": ("[tool..position]", {}, "0.select: 'tool..position': the robot has no arm ''; it has one tool"),
    "unknown part": ("[tool.position, tool.rotation]", {}, "0.select: 'tool.rotation': the tool has no 'rotation'"),
    "two orientations": ("[tool.position, tool.rotation_6d, tool.quaternion]", {}, "at most one orientation"),
    "no position": ("[tool.rotation_6d]", {}, "needs one position"),
    "half relative": ("[tool.delta_position, tool.rotation_6d]", {}, "both relative"),
    "gripper twice": ("[tool.gripper, tool.gripper]", {}, "the gripper is there twice"),
    "two kinds": ("[tool.position, delta.shoulder_pan]", {}, "features of one kind"),
    "an arm that is not there": ("[tool.left.position]", {}, "no arm 'left'; it has one tool: tool.position"),
    "not all joints": ("[delta.shoulder_pan]", {}, "all joints of the executor in their order: [delta.shoulder_pan, "),
    "gripper of the arm": ("[tool.gripper]", {}, "determine the joints gripper; the executor has: shoulder_pan"),
    "not all of the arm": (
        "[tool.position, tool.gripper]",
        {},
        "wrist_roll, gripper; the executor has: shoulder_pan, shoulder_lift, elbow_flex, wrist_flex, wrist_roll",
    ),
    "no site": (POSES, {"robot.description.tip": "nose"}, "'nose'"),
    "paths of messages": ("[data.0, data.1, data.2, data.3, data.4]", {}, "'data.0' is computed by no"),
}  # fmt: skip
"""What is wrong -> the arm's select, other overrides, and part of the message."""


@pytest.mark.parametrize("name", CHANGES)
def test_wrong_features_of_an_action_are_named(name: str) -> None:
    select, more, message = CHANGES[name]
    given = overrides(select, *(f"{key}={value}" for key, value in more.items()), observations=f"[{STATE}]")
    with pytest.raises(ConfigError) as error:
        load_config(find_config("so101_blind", installed_plugins()), overrides=given, sim=True)
    assert message in str(error.value)


def test_relative_action_without_its_reference_is_named() -> None:
    given = overrides(DELTAS, observations="[{key: observation.state, topic: /joint_states, select: [tool.position]}]")
    with pytest.raises(
        ConfigError, match=r"contract\.actions\.0\.select: a relative action needs .* position\.shoulder_pan"
    ):
        load_config(find_config("so101_blind", installed_plugins()), overrides=given, sim=True)


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("tool.delta_position", "only an action is relative"),
        ("tool.pose", "the tool has no 'pose'"),
        ("delta.shoulder_pan", "only an action is relative"),
        ("tol.position", "expected position.JOINT"),
    ],
)
def test_wrong_features_of_an_observation_are_named(path: str, message: str) -> None:
    given = (f"contract.observations=[{{key: observation.state, topic: /joint_states, select: [{path}]}}]",)
    with pytest.raises(ConfigError) as error:
        load_config(find_config("so101_blind", installed_plugins()), overrides=given, sim=True)
    assert "contract.observations.0.select" in str(error.value)
    assert message in str(error.value)


def test_tools_of_two_arms_are_named_by_their_arm() -> None:
    both = "{key: observation.tools, topic: /joint_states, select: [tool.left.position, tool.right.rotation_vector]}"
    observations = f"contract.observations=[{STATE}, {both}]"
    config = load_config(
        find_config("bi_so101", installed_plugins()),
        overrides=(
            observations,
            "contract.actions.0.select=[tool.left.position, tool.left.rotation_vector, tool.left.gripper]",
        ),
        sim=True,
    )
    contract = Contract.from_config(config)
    turns = ("left_ee.wx", "left_ee.wy", "left_ee.wz")
    assert contract.features()["observation.tools"].names == (
        "left_ee.x", "left_ee.y", "left_ee.z", *(name.replace("left", "right") for name in turns),
    )  # fmt: skip
    names = ("left_ee.x", "left_ee.y", "left_ee.z", *turns, "left_ee.gripper_pos")
    assert contract.features()["action"].names[:7] == names
    q = np.linspace(-0.2, 0.3, len(contract.action_joints))
    made = calibrated_units("radians", contract, {}, config.document)({"action": q})["action"]
    tip = robot_model(config.robot, contract.action_parts[0].joints).forward(q[:6])
    np.testing.assert_allclose(made[:7], [*tip.position, *log(tip.rotation), q[5]], atol=1e-8)
    with pytest.raises(ConfigError, match=r"several tools; name the arm, e\.g\. tool\.left\.position"):
        load_config(
            find_config("bi_so101", installed_plugins()),
            overrides=("contract.actions.0.select=[tool.position]",),
            sim=True,
        )


@pytest.mark.long
def test_scripted_expert_through_poses_succeeds_as_through_joints() -> None:
    joints, tool = (experts.run("so101_blind", None, given, 0, 100) for given in ((), experts.TOOL))
    assert sum(tool.won) >= 95
    assert sum(tool.won) >= sum(joints.won) - 2
    assert tool.summary["unreachable"] == 0

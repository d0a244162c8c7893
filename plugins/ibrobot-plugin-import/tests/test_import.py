"""`ibrobot config import`: every value of a file gets a verdict, and each line of the new file a comment."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import yaml
from click.testing import CliRunner
from ibrobot_import import command
from ibrobot_import.command import convert_file, write
from ibrobot_import.draft import scalar
from ibrobot_import.source import Fate
from ibrobot_testing.command import command_line

from ibrobot_core.api import MESSAGE_TYPES
from ibrobot_core.app import ConfigError, parse_yaml

FILES = Path(__file__).with_name("files")
COUNTS = {
    "ib_robot_arm.yaml": (61, 28, 44),
    "ib_robot_base.yaml": (15, 0, 12),
    "ib_robot_contract.yaml": (12, 0, 7),
    "ib_robot_two_arms.yaml": (16, 9, 1),
    "lerobot_calibration.json": (30, 0, 0),
    "lerobot_client.yaml": (8, 2, 9),
    "lerobot_record.json": (10, 4, 8),
    "lerobot_robot.yaml": (12, 4, 4),
    "lerobot_two_arms.yaml": (9, 4, 2),
    "rosetta_arm.yaml": (12, 7, 12),
    "rosetta_base.yaml": (25, 1, 23),
}
"""File -> values taken, changed and refused."""


def leaves(value: Any) -> int:
    """Values of a file; a list of plain values counts as one."""
    if isinstance(value, Mapping) and value:
        return sum(map(leaves, value.values()))
    if isinstance(value, list) and any(isinstance(each, Mapping | list) for each in value):
        return sum(map(leaves, value))
    return 1


def imported(name: str, **options: bool) -> tuple[dict[str, Any], dict[str, str]]:
    """The values of the new file, and key -> why it was refused."""
    found = convert_file(FILES / name, **options)
    document = parse_yaml(found.draft.text, "new.yaml", expands=False)
    document.raise_problems()
    return document.root, {each.key: each.reason for each in found.verdicts if each.fate is Fate.REFUSED}


@pytest.mark.parametrize("name", sorted(path.name for path in FILES.iterdir()))
def test_no_value_is_dropped_in_silence(name: str) -> None:
    found = convert_file(FILES / name)
    count = found.count()
    assert sum(count.values()) == leaves(yaml.safe_load((FILES / name).read_text()))
    assert (count[Fate.TAKEN], count[Fate.CHANGED], count[Fate.REFUSED]) == COUNTS[name]
    assert all(each.reason for each in found.verdicts if each.fate is not Fate.TAKEN)
    assert all(each.line > 0 for each in found.verdicts)
    named = {int(line) for line in re.findall(r"  # line (\d+):", found.draft.text)}
    unread = [each for each in found.verdicts if each.fate is not Fate.REFUSED and not each.reason]
    assert [each for each in unread if each.line not in named] == []


@pytest.mark.parametrize("name", sorted(path.name for path in FILES.iterdir()))
def test_each_value_says_where_it_comes_from(name: str) -> None:
    lines = convert_file(FILES / name).draft.text.splitlines()
    assert [each for each in lines if each and ":" in each.partition("#")[0].rstrip(": ") and "  # " not in each] == []


def test_servos_of_ib_robot_become_joints() -> None:
    new, refused = imported("ib_robot_arm.yaml")
    joints = {each["name"]: each for each in new["robot"]["joints"]}
    assert (joints["shoulder_pan"]["lower"], joints["shoulder_pan"]["upper"]) == (-1.0, 1.91986)
    assert (joints["gripper"]["lower"], joints["gripper"]["upper"]) == (0.0, 1.0)
    assert new["robot"]["description"]["poses"]["reset"] == [0.1, -1.5, 1.5, 0.0, 0.0, 0.0]
    assert new["contract"]["observations"][1]["select"] == [f"position.{name}" for name in joints]
    assert new["hardware"] == {
        "type": "feetech_so101",
        "port": "/dev/ttyACM7",
        "calibration": "${HOME}/.calibrate/bench.json",
    }
    assert refused["robot.peripherals.laser.port"] == "there is no plugin here for a lidar with driver ldlidar"
    assert refused["robot.left_over"] == "without a counterpart here; ibrobot does not know it as a key of IB-Robot"


def test_modes_of_ib_robot() -> None:
    new, refused = imported("ib_robot_arm.yaml")
    modes = new["control_modes"]
    assert modes["teleop"] == {"executors": ["arm_position", "gripper_position"], "teleop": "leader"}
    assert modes["model_inference"]["inference"] == {"model": "pick_act"}
    assert modes["model_inference"]["dispatch"] == {"watermark": 12}
    assert modes["moveit_planning"]["executors"] == ["arm_trajectory", "gripper_action"]
    assert "transport" in refused["robot.control_modes.model_inference.inference.execution_mode"]
    assert "20 Hz" in refused["robot.control_modes.teleop.executor.control_frequency"]
    assert [each["safety_behavior"] for each in new["contract"]["actions"]] == ["hold", "hold"]


def test_cameras_of_ib_robot() -> None:
    top, front = imported("ib_robot_arm.yaml")[0]["peripherals"]
    assert (top["device"], top["fourcc"]) == (4, "MJPG")
    assert "brightness" not in top
    mount = {"parent": "base_link", "xyz": [0.1, 0.0, 0.5], "rpy": [0.0, 1.2, 0.0], "frame": "camera_top_frame"}
    assert top["transform"] == mount
    assert front["type"] == "realsense"


def test_two_arms_of_ib_robot() -> None:
    new, _ = imported("ib_robot_two_arms.yaml")
    assert list(new["hardware"]) == ["left_follower", "right_follower"]
    assert new["contract"]["observations"][1]["select"] == ["position.left_shoulder_pan", "position.right_gripper"]
    assert [each["executor"] for each in new["contract"]["actions"]] == ["left_position", "right_position"]


@pytest.mark.parametrize("name", ["ib_robot_base.yaml", "ib_robot_contract.yaml", "rosetta_base.yaml"])
def test_contract_alone_of_robot_without_driver(name: str, tmp_path: Path) -> None:
    found = convert_file(FILES / name)
    assert found.alone
    write(found, FILES / name, tmp_path / "new.yaml")


def test_what_a_contract_alone_lacks_for_a_launch_is_printed(tmp_path: Path) -> None:
    done = CliRunner().invoke(
        command_line("config import"), [str(FILES / "ib_robot_contract.yaml"), str(tmp_path / "new.yaml")]
    )
    assert done.exit_code == 0, done.output
    assert "12 values taken, 0 changed, 7 without a counterpart" in done.output
    lacks = "it has no robot, executors, control_modes, default_control_mode, hardware"
    assert f"not for `ibrobot launch`: {lacks}. To launch such a robot, copy its observations" in done.output
    assert "# A contract alone, for `ibrobot convert --config`." in (tmp_path / "new.yaml").read_text()


def test_sources_and_signals_of_rosetta() -> None:
    new, refused = imported("rosetta_base.yaml")
    contract = new["contract"]
    assert [each["key"] for each in contract["observations"]] == ["observation.state"] * 2 + ["observation.load"]
    known = "nav_msgs/msg/Odometry" in MESSAGE_TYPES  # with ibrobot-ros2
    assert ("foreign" in contract["observations"][1]) == (not known)
    assert contract["observations"][2]["select"] == ["data.0", "data.1"]
    assert contract["actions"][0]["joints"] == ["linear.x", "angular.z"]
    assert [each["key"] for each in contract["signals"]] == ["task", "next.reward"]
    assert "computed by code" in refused["observations.observation.battery.channel.topic"]
    assert refused["actions.action.lamp.channel.topic"] == "there is one action vector, `action`"


def test_arm_of_rosetta_becomes_a_robot() -> None:
    new, refused = imported("rosetta_arm.yaml")
    state = new["contract"]["observations"][1]
    assert state["topic"] == "/joint_states"
    assert state["select"][2:] == [
        "position.elbow_flex",
        "position.wrist_flex",
        "position.wrist_roll",
        "position.gripper",
    ]
    assert "GUESS, as the only one left: jaw is gripper" in convert_file(FILES / "rosetta_arm.yaml").draft.text
    assert new["contract"]["observations"][0]["align"] == {"strategy": "asof", "stamp": "header", "tol_ms": 60}
    assert "norm_mode: degrees" in refused["observations.observation.state.apply"]
    assert not any(key.startswith("x-qos") for key in refused)


def test_arm_of_rosetta_as_contract_alone(tmp_path: Path) -> None:
    found = convert_file(FILES / "rosetta_arm.yaml", contract=True)
    write(found, FILES / "rosetta_arm.yaml", tmp_path / "new.yaml")
    assert "/follower/joint_states" in found.draft.text


def test_robot_of_lerobot(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HF_LEROBOT_CALIBRATION", str(tmp_path))
    old = tmp_path / "robots" / "so101_follower" / "my_arm.json"
    assert imported("lerobot_robot.yaml")[0]["hardware"]["calibration"] == str(
        tmp_path / "robots/so_follower/my_arm.json"
    )
    old.parent.mkdir(parents=True)
    old.write_text("{}")
    new, refused = imported("lerobot_robot.yaml")
    assert new["hardware"]["calibration"] == str(old)
    assert new["control"]["stop"] == "relax"
    assert [each["type"] for each in new["peripherals"]] == ["opencv", "realsense"]
    assert new["peripherals"][0]["rotation"] == 270
    assert "max_velocity" in refused["max_relative_target"]


def test_recording_of_lerobot() -> None:
    new, refused = imported("lerobot_record.json")
    assert (new["contract"]["rate_hz"], new["contract"]["max_duration_s"]) == (30, 20)
    assert "--dataset" in refused["dataset.repo_id"]
    assert new["models"]["policy"] == {"type": "lerobot", "path": "outputs/act", "norm_mode": "degrees"}
    assert new["teleoperation"]["leader"]["port"] == "/dev/ttyACM1"
    assert refused["dataset.single_task"] == "`ibrobot record --prompt`"
    assert refused["strange"] == "without a counterpart here; ibrobot does not know it as a key of LeRobot"


def test_client_of_lerobots_policy_server() -> None:
    new, refused = imported("lerobot_client.yaml")
    assert (new["contract"]["rate_hz"], new["models"]["policy"]["type"]) == (20, "lerobot")
    assert new["models"]["policy"]["path"] == "outputs/train/act/checkpoints/last/pretrained_model"
    assert new["control_modes"]["model_inference"]["inference"]["model"] == "policy"
    assert [key for key, why in refused.items() if "does not know it" in why] == []
    assert "ibrobot serve" in refused["server_address"]


def test_two_arms_of_lerobot() -> None:
    new, _ = imported("lerobot_two_arms.yaml")
    assert [each["port"] for each in new["hardware"].values()] == ["/dev/ttyACM0", "/dev/ttyACM1"]
    assert new["control_modes"]["teleop"]["teleop"] == {"left": "leader_left", "right": "leader_right"}
    assert new["peripherals"][0]["name"] == "left_wrist"


WRONG = {
    "robot: [": ("1", "not valid YAML"),
    "robot: {name: a, ros2_control: {hardware_plugin: so101_hardware/SO101SystemHardware, port: [1]}}":
        ("1: robot.ros2_control.port", "expected a text, got [1]"),
    "robot:\n  name: a\n  contract: {rate_hz: fast}": ("3: robot.contract.rate_hz", "expected a number, got 'fast'"),
    "robot:\n  name: a\n  contract:\n    observations: {key: x}":
        ("4: robot.contract.observations", "expected a list, got {'key': 'x'}"),
    "robot:\n  name: a\n  name: b\n  contract: {}": ("3: robot.name", "repeated key, first given in line 2"),
    "robot: &a\n  contract: {rate_hz: 20}\n  peripherals: *a":
        ("1: robot.peripherals", "an alias to the block that contains it"),
    "type: koch_follower\nport: /dev/ttyACM0": ("1: type", "there is no plugin here for 'koch_follower'"),
    "robot_type: a\nrobot_interface: ros1\nfps: 3": ("2: robot_interface", "expected ros2, got 'ros1'"),
    "robot_type: so_101\nobservations: {o: {channel: {topic: 5}, align: {timeline: sim}}}":
        ("2", "expected header or receive, got 'sim'"),
    "robot:\n  name: ${SECRET}\n  ros2_control: {hardware_plugin: so101_hardware/SO101SystemHardware}":
        ("2: robot.name", "ibrobot would read ${…} as a variable"),
    "robot:\n  ros2_control:\n    hardware_plugin: so101_hardware/SO101SystemHardware\n  joints:\n    arm: ['1', '9']":
        ("5: robot.joints.arm", "unknown joint '9'"),
    "- 1": ("", "expected a mapping of sections"),
    "a: 1": ("", "has an unknown format, with the keys a"),
    "x" * 300_000: ("", "too long: a robot YAML has at most 256 kB"),
    "robot: " + "[" * 80: ("1", "nested more than 50 levels deep"),
    "robot:\n  x: &x [1, 2, 3, 4, 5, 6, 7, 8, 9]\n  y: &y [*x, *x, *x, *x, *x, *x, *x, *x, *x]\n"
    "  z: &z [*y, *y, *y, *y, *y, *y, *y, *y, *y]\n  w: [*z, *z, *z, *z, *z, *z, *z, *z, *z, *z, *z, *z]":
        ("2", "more than 10000 values"),
}  # fmt: skip
"""Text of a file -> the place and the reason of its error."""


@pytest.mark.parametrize("text", WRONG, ids=[f"{i}: {text[:40]!r}" for i, text in enumerate(WRONG)])
def test_wrong_file_is_refused_with_its_line(text: str, tmp_path: Path) -> None:
    path = tmp_path / "old.yaml"
    path.write_text(text)
    place, reason = WRONG[text]
    with pytest.raises(ConfigError) as error:
        convert_file(path)
    assert str(error.value).startswith(f"{path}:{place}")
    assert reason in str(error.value)


def test_wrong_value_is_reported_at_its_place_in_the_old_file(tmp_path: Path) -> None:
    old = tmp_path / "old.yaml"
    old.write_text((FILES / "ib_robot_contract.yaml").read_text().replace("rate_hz: 20", "rate_hz: -20"))
    with pytest.raises(ConfigError, match=r"old\.yaml:4: contract\.rate_hz: -20"):
        write(convert_file(old), old, tmp_path / "new.yaml")
    assert not (tmp_path / "new.yaml").exists()


def test_existing_file_is_kept(tmp_path: Path) -> None:
    (tmp_path / "new.yaml").write_text("mine")
    old = FILES / "ib_robot_contract.yaml"
    with pytest.raises(ConfigError, match="exists already, and is not overwritten"):
        write(convert_file(old), old, tmp_path / "new.yaml")
    assert (tmp_path / "new.yaml").read_text() == "mine"


@pytest.mark.parametrize(
    "value",
    [
        "a: b",
        "# no",
        "- x",
        "yes",
        "1e3",
        "\n",
        "\x1b[31m",
        '"',
        "\\",
        "\U000e0001",
        "é",
        "",
        " a",
        1.5,
        -0.0,
        True,
        None,
        3,
    ],
)
def test_scalars_are_read_back(value: object) -> None:
    text = f"key: {scalar(value)}  # comment"
    assert text.isprintable()
    assert parse_yaml(text, "new.yaml", expands=False).root == {"key": value}


def test_wrong_calibration_is_refused(tmp_path: Path) -> None:
    numbers = json.loads((FILES / "lerobot_calibration.json").read_text())
    numbers["gripper"]["range_min"] = 9000
    path = tmp_path / "arm.json"
    path.write_text(json.dumps(numbers))
    with pytest.raises(Exception, match="gripper: range_min: must be 0 to 4095, not 9000"):
        convert_file(path)


def test_an_interrupted_import_leaves_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(command, "load_config", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write(convert_file(FILES / "ib_robot_arm.yaml"), FILES / "ib_robot_arm.yaml", tmp_path / "new.yaml")
    assert list(tmp_path.iterdir()) == []

"""A foreign bag by a contract alone: drafted from the bag, chosen by a person, converted without a robot."""

from __future__ import annotations

import json
import subprocess
from contextlib import chdir
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from command_line import run_here
from ibrobot_data.config_metadata import load_contract
from ibrobot_ros2 import encode
from recordings import JOINTS, SIZE, START_NS, numbered
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from ibrobot_core.errors import ConfigError
from ibrobot_core.messages import (
    Bool,
    Float32MultiArray,
    Float64MultiArray,
    Header,
    Image,
    Imu,
    JointState,
    Message,
    String,
)

pytestmark = [pytest.mark.integration, pytest.mark.usefixtures("first_conversion")]

COMMANDS = "/arm_controller/commands"
CONTRACT = """\
contract:
  rate_hz: 30
  observations:
    - {key: observation.state, topic: /joint_states, select: [position.pan]}
  actions:
    - {topic: /commands, joints: [pan]}
"""


def ibrobot(folder: Path, *arguments: object) -> subprocess.CompletedProcess[str]:
    with chdir(folder):
        return run_here(*arguments)


def write(bag: Path, events: list[tuple[int, str, Message]]) -> None:
    """A bag as rosbags writes it, of times of receipt [ns], topics and messages."""
    store = get_typestore(Stores.ROS2_JAZZY)
    with Writer(bag, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        known = {}
        for at_ns, topic, message in sorted(events, key=lambda event: event[0]):
            if topic not in known:
                known[topic] = writer.add_connection(topic, message.ros_type, typestore=store)
            writer.write(known[topic], at_ns, bytes(encode(message)))


@pytest.fixture
def kitchen(tmp_path: Path) -> Path:
    """A clean folder with a foreign bag: states at 100 Hz, commands of two parts at 30, a camera at 30, an IMU."""
    events: list[tuple[int, str, Message]] = []
    for i in range(100):
        at_ns = START_NS + i * 10_000_000
        events.append((at_ns, "/joint_states", JointState(Header(at_ns), JOINTS, [i / 100, 0.0, 1.0])))
        events.append((at_ns, "/imu/data", Imu(Header(at_ns))))
    for i in range(30):
        at_ns = START_NS + 3_000_000 + i * 33_333_333
        events.append((at_ns, COMMANDS, Float64MultiArray(np.full(3, float(i)))))
        events.append((at_ns, "/gripper_controller/commands", Float64MultiArray([0.5])))
        picture = Image(Header(at_ns), *SIZE, "rgb8", SIZE[1] * 3, numbered(i).ravel())
        events.append((at_ns, "/camera/top/image_raw", picture))
    write(tmp_path / "kitchen", events)
    return tmp_path


def test_a_drafted_contract_converts_the_bag_that_it_is_from(kitchen: Path) -> None:
    drafted = ibrobot(kitchen, "contract", "init", "kitchen", "-o", "kitchen.yaml")
    assert drafted.returncode == 0, drafted.stderr
    assert "kitchen.yaml: read it, then `ibrobot convert kitchen --config kitchen.yaml" in drafted.stdout
    assert (kitchen / "kitchen.yaml").read_text().count("# CHOOSE") >= 5
    done = ibrobot(
        kitchen, "convert", "kitchen", "--config", "kitchen.yaml", "--prompt", "clear", "--out", "set", "--json"
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["frames"] > 25
    info = json.loads((kitchen / "set/meta/info.json").read_bytes())
    assert info["features"]["observation.images.top"]["shape"] == [*SIZE, 3]
    assert info["features"]["observation.state"]["names"] == [f"{joint}.pos" for joint in JOINTS]
    assert info["features"]["action"]["names"] == [f"joint_{i}.pos" for i in range(4)]
    table = pq.read_table(kitchen / "set/data/chunk-000/file-000.parquet").to_pydict()
    actions = [row[0] for row in table["action"]]
    assert actions == [actions[0] + i for i in range(len(actions))], "the next command after each picture"
    again = ibrobot(kitchen, "contract", "init", "kitchen", "-o", "kitchen.yaml")
    assert (again.returncode, "File exists" in again.stderr) == (2, True)


SIGNALS = {
    "/agent/reward": Float32MultiArray([0.5]),
    "/episodeDone": Bool(data=False),
    "/task/instruction": String("clear the table"),
}


def test_signals_are_drafted_as_comments_that_work_when_uncommented(tmp_path: Path) -> None:
    stamps = [START_NS + i * 33_333_333 for i in range(30)]
    events: list[tuple[int, str, Message]] = [(at_ns, t, each) for at_ns in stamps for t, each in SIGNALS.items()]
    events += [(at_ns, "/joint_states", JointState(Header(at_ns), JOINTS, np.zeros(3))) for at_ns in stamps]
    events += [(at_ns, COMMANDS, Float64MultiArray(np.zeros(3))) for at_ns in stamps]
    events += [(at_ns, "/abandoned", Bool(data=True)) for at_ns in stamps]
    write(tmp_path / "bag", events)
    assert ibrobot(tmp_path, "contract", "init", "bag", "-o", "bag.yaml").returncode == 0
    before = load_contract(tmp_path / "bag.yaml").contract
    assert before.signals == ()
    assert [each.topic for each in before.observations] == ["/abandoned", "/joint_states"]
    text = (tmp_path / "bag.yaml").read_text()
    (tmp_path / "bag.yaml").write_text(text.replace("\n  #  ", "\n   ").replace("\n  # signals", "\n  signals"))
    found = [
        (each.key, each.topic, *each.select, each.align)
        for each in load_contract(tmp_path / "bag.yaml").contract.signals
    ]
    assert found == [
        ("next.reward", "/agent/reward", "data.0", "next"),
        ("next.done", "/episodeDone", "data", "hold"),
        ("task", "/task/instruction", "data", "hold"),
    ]
    done = ibrobot(tmp_path, "convert", "bag", "--config", "bag.yaml", "--out", "set")
    assert done.returncode == 0, done.stderr
    table = pq.read_table(tmp_path / "set/data/chunk-000/file-000.parquet").to_pydict()
    assert {row for row in table["next.reward"]} == {0.5}
    assert {row for row in table["next.done"]} == {False}


def test_two_topics_of_a_camera_are_drafted_with_names_of_their_own(tmp_path: Path) -> None:
    picture = Image(Header(START_NS), *SIZE, "rgb8", SIZE[1] * 3, numbered(1).ravel())
    topics = ("/camera/top/image_raw", "/camera/top/image_raw/compressed")
    write(tmp_path / "bag", [(START_NS, topic, picture) for topic in topics])
    assert ibrobot(tmp_path, "contract", "init", "bag", "-o", "bag.yaml").returncode == 0
    assert (tmp_path / "bag.yaml").read_text().count("CHOOSE: another topic") == 2
    keys = [each.key for each in load_contract(tmp_path / "bag.yaml").contract.observations]
    assert keys == ["observation.images.camera_top_image_raw", "observation.images.camera_top_image_raw_compressed"]


MISTAKES = {
    "no joints": ("{topic: /commands, joints: [pan]}", "{topic: /commands}", "needs joints: the names of its numbers"),
    "an executor": ("joints: [pan]", "joints: [pan], executor: arm", "executor has no meaning in a contract alone"),
    "no paths": ("joints: [pan]", "joints: [pan], type: trajectory_msgs/msg/JointTrajectory", "needs a select: paths"),
    "a misspelt key": ("rate_hz", "rate_zh", "did you mean 'rate_hz'"),
}


@pytest.mark.parametrize("case", MISTAKES)
def test_what_is_wrong_in_a_contract_alone_is_named_with_its_line(tmp_path: Path, case: str) -> None:
    old, new, message = MISTAKES[case]
    (tmp_path / "contract.yaml").write_text(CONTRACT)
    assert load_contract(tmp_path / "contract.yaml").contract.actions[0].joints == ("pan",)
    (tmp_path / "contract.yaml").write_text(CONTRACT.replace(old, new))
    with pytest.raises(ConfigError, match=rf"contract.yaml:\d+: contract.*{message}"):
        load_contract(tmp_path / "contract.yaml")

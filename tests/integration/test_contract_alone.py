"""A bag of others by a contract alone: drafted from the bag, chosen by a person, converted without a robot."""

from __future__ import annotations

import json
import subprocess
from contextlib import chdir
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from command_line import run_here
from ibrobot_ros2 import encode
from recordings import JOINTS, SIZE, START_NS, numbered
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from ibrobot_core.config.load import load_contract
from ibrobot_core.errors import ConfigError
from ibrobot_core.messages import Float64MultiArray, Header, Image, Imu, JointState

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


@pytest.fixture
def kitchen(tmp_path: Path) -> Path:
    """A clean folder with a bag of others: states at 100 Hz, commands of two parts at 30, a camera at 30, an IMU."""
    store = get_typestore(Stores.ROS2_JAZZY)
    events = []
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
    with Writer(tmp_path / "kitchen", version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        known = {}
        for at_ns, topic, message in sorted(events, key=lambda event: event[0]):
            if topic not in known:
                known[topic] = writer.add_connection(topic, message.ros_type, typestore=store)
            writer.write(known[topic], at_ns, bytes(encode(message)))
    return tmp_path


def test_a_drafted_contract_converts_the_bag_that_it_is_from(kitchen: Path) -> None:
    drafted = ibrobot(kitchen, "contract", "init", "kitchen", "-o", "kitchen.yaml")
    assert drafted.returncode == 0, drafted.stderr
    assert "kitchen.yaml: read it, then ibrobot convert kitchen --config kitchen.yaml" in drafted.stdout
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
    assert (again.returncode, "File exists" in again.stderr) == (1, True)


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

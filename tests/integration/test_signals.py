"""Signals of a contract: what a topic says of the rows of a dataset."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from ibrobot_data.config_metadata import load_contract
from ibrobot_data.episode import DATASET, Job, convert_episode
from ibrobot_data.request import ConversionRequest, EpisodeReport
from ibrobot_lerobot.options import LeRobotOptions
from ibrobot_ros2 import encode
from recordings import JOINTS, START_NS
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from ibrobot_core.contract.specs import Contract
from ibrobot_core.errors import ConfigError
from ibrobot_core.messages import Bool, Float64MultiArray, Header, JointState, String
from ibrobot_core.plugins import installed_plugins

pytestmark = pytest.mark.integration

PROGRAM = "from ibrobot_core.cli.main import main; main()"
ALONE = """\
contract:
  rate_hz: 10
  observations:
    - {key: observation.state, topic: /joint_states, select: [position.pan]}
  actions:
    - {topic: /commands, joints: [pan]}
"""
SIGNALS = """\
  signals:
    - {key: task, topic: /instruction}
    - {key: next.reward, topic: /reward, align: next}
    - {key: next.done, topic: /done}
"""
STEP_NS = 100_000_000


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two seconds at 10 Hz; a reward 10 ms after each step, two tasks, and done at the last step."""
    folder = tmp_path_factory.mktemp("signals") / "bag"
    store = get_typestore(Stores.ROS2_JAZZY)
    reward = store.types["std_msgs/msg/Float32"]
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        known: dict[str, Any] = {}

        def write(topic: str, type_: str, at_ns: int, data: bytes) -> None:
            if topic not in known:
                known[topic] = writer.add_connection(topic, type_, typestore=store)
            writer.write(known[topic], at_ns, data)

        for i in range(20):
            at_ns = START_NS + i * STEP_NS
            if i in (0, 12):
                text = String("open the drawer" if i == 0 else "take the cup")
                write("/instruction", String.ros_type, at_ns, bytes(encode(text)))
            state = JointState(Header(at_ns), JOINTS, [float(i), 0.0, 0.0])
            write("/joint_states", JointState.ros_type, at_ns, bytes(encode(state)))
            write("/commands", Float64MultiArray.ros_type, at_ns, bytes(encode(Float64MultiArray([float(i)]))))
            write("/done", Bool.ros_type, at_ns, bytes(encode(Bool(i == 19))))
            data = bytes(store.serialize_cdr(reward(i / 8), reward.__msgtype__))
            write("/reward", reward.__msgtype__, at_ns + 10_000_000, data)
    return folder


def contract(folder: Path, text: str) -> Contract:
    path = folder / "contract.yaml"
    path.write_text(text)
    return Contract.from_config(load_contract(path))


def converted(bag: Path, folder: Path, text: str) -> tuple[dict[str, list[Any]], EpisodeReport]:
    """The columns of the dataset of a bag, its task as text, and what the conversion reports."""
    request = ConversionRequest(
        folder / "set", LeRobotOptions(), "lerobot", contract=contract(folder, text), prompt="by hand"
    )
    report = convert_episode(Job(request, bag, "bag", folder / "unit"), lambda frames: None)
    if report.error:
        return {}, report
    columns = pq.read_table(folder / "unit" / DATASET / "data/chunk-000/file-000.parquet").to_pydict()
    tasks = pq.read_table(folder / "unit" / DATASET / "meta/tasks.parquet").to_pylist()
    texts = {each["task_index"]: each.get("task", each.get("__index_level_0__")) for each in tasks}
    return {**columns, "task": [texts[number] for number in columns["task_index"]]}, report


TASKS = ["open the drawer"] * 12 + ["take the cup"] * 8


def test_rows_have_the_task_reward_and_end_of_their_ticks(bag: Path, tmp_path: Path) -> None:
    columns, report = converted(bag, tmp_path, ALONE + SIGNALS)
    assert columns["observation.state"] == [float(i) for i in range(20)]
    assert columns["next.reward"] == [i / 8 for i in range(20)], "the first after each tick"
    assert columns["next.done"] == [False] * 19 + [True]
    assert columns["task"] == TASKS
    assert (report.prompt, dict(report.resets)) == ("open the drawer; take the cup", {})


def test_alignment_says_which_message_is_of_a_row(bag: Path, tmp_path: Path) -> None:
    swapped = SIGNALS.replace("/reward, align: next", "/reward").replace("/instruction", "/instruction, align: next")
    columns, _ = converted(bag, tmp_path, ALONE + swapped)
    # The first row is the first with a reward before it; rows end where no task follows.
    assert columns["next.reward"] == [i / 8 for i in range(11)]
    assert columns["observation.state"] == [float(i) for i in range(1, 12)]
    assert columns["task"] == ["take the cup"] * 11


def test_without_signals_rows_have_none_and_the_prompt_is_their_task(bag: Path, tmp_path: Path) -> None:
    columns, _ = converted(bag, tmp_path, ALONE)
    assert not [key for key in columns if key.startswith("next.")]
    assert set(columns["task"]) == {"by hand"}


def test_signals_shape_the_data_and_do_not_come_back_from_a_dataset(bag: Path, tmp_path: Path) -> None:
    plain, labelled = contract(tmp_path, ALONE), contract(tmp_path, ALONE + SIGNALS)
    assert Contract.from_canonical(labelled.canonical()).fingerprint() == labelled.fingerprint() != plain.fingerprint()
    assert labelled.without_signals().fingerprint() == plain.fingerprint()
    assert "next.reward" in labelled.difference(plain)
    command = [sys.executable, "-c", PROGRAM, "convert", str(bag), "--config", "contract.yaml", "--out", "set"]
    subprocess.run(command, cwd=tmp_path, check=True, capture_output=True)
    reader = installed_plugins().open_episode(tmp_path / "set:0")
    try:
        assert set(reader.summary().topics) == {"/joint_states", "/commands"}
        assert len(list(reader.messages())) == 40
    finally:
        reader.close()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("/instruction", "/nowhere", "no message of /nowhere, which the contract needs"),
        ("/instruction", "/reward, type: std_msgs/msg/Float32", "'data' is not a text in a std_msgs/msg/Float32"),
        ("/reward, align: next", "/reward, select: [value]", "next.reward: /reward.*no field 'value'; available: data"),
        ("/reward, align: next", "/done", "next.reward: /done.* is a std_msgs/msg/Float32, got a std_msgs/msg/Bool"),
    ],
)
def test_signal_that_the_bag_does_not_have_is_named(
    bag: Path, tmp_path: Path, old: str, new: str, message: str
) -> None:
    _, report = converted(bag, tmp_path, ALONE + SIGNALS.replace(old, new))
    assert re.search(message, report.error), report.error


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("key: task", "key: next.success", "signals.0.key: 'next.success' is not one of: task, next.reward, next.done"),
        ("key: next.done", "key: task", "signals.2.key: task is given twice; give it once"),
        ("topic: /done", "topic: done", "signals.2.topic: a topic starts with /, got 'done'"),
        ("topic: /done", "topic: /done, type: Bool", "signals.2.type: expected PACKAGE/msg/NAME, got 'Bool'"),
        ("topic: /done", "topic: /done, select: [a, b]", "signals.2.select: next.done takes one path, e.g. [data]"),
        ("topic: /done", "topic: /done, select: [on]", "signals.2.select.0: 'on': Bool has no field 'on'"),
        ("align: next", "align: asof", "signals.1.align: 'asof' is not one of: hold, next"),
    ],
)
def test_wrong_signal_is_named_with_its_line(tmp_path: Path, old: str, new: str, message: str) -> None:
    with pytest.raises(ConfigError, match=rf"contract.yaml:\d+: contract.{re.escape(message)}"):
        contract(tmp_path, ALONE + SIGNALS.replace(old, new))

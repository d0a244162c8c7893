"""Topics between a run and a node of rclpy's, both ways."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ibrobot_ros2 import encode

from ibrobot_core.api import (
    MESSAGE_TYPES,
    Bool,
    CameraInfo,
    CompressedImage,
    DiagnosticArray,
    DiagnosticStatus,
    Header,
    Image,
    Imu,
    JointState,
    JointTrajectory,
    JointTrajectoryPoint,
    Joy,
    KeyValue,
    MultiArrayDimension,
    MultiArrayLayout,
    PointCloud2,
    PointField,
    Pose,
    PoseStamped,
    Quaternion,
    String,
    TFMessage,
    TransformStamped,
    Twist,
    TwistStamped,
    Vector3,
)

from .conftest import DOMAIN, HERE, PYTHON, until

HEADER = Header(1_700_000_000_123_456_789, "base")
POSE = Pose(Vector3(1.0, 2.0, 3.0), Quaternion(0.1, 0.2, 0.3, 0.9))
TWIST = Twist(Vector3(1.0, 2.0, 3.0), Vector3(4.0, 5.0, 6.0))


def made(**types):
    """An example of each type of the vocabulary."""
    layout = MultiArrayLayout((MultiArrayDimension("x", 3, 3),), 1)
    given: dict[str, Any] = {
        "Bool": {"data": True},
        "Int8": {"data": -7},
        "Int32": {"data": 123456},
        "String": {"data": "naïve 日本"},
        "Float32MultiArray": {"data": [1.5, float("inf"), -0.0], "layout": layout},
        "Float64MultiArray": {"data": [1.5, float("nan"), -0.0], "layout": layout},
        "Int32MultiArray": {"data": [1, -2, 3], "layout": layout},
    }
    examples = {name: MESSAGE_TYPES[f"std_msgs/msg/{name}"](**fields) for name, fields in given.items()}
    many = [
        JointState(HEADER, ("a", "bc"), [1.0, 2.0], [3.0, 4.0], [float("nan"), 6.0]),
        Image(HEADER, 2, 3, "rgb8", 9, np.arange(18, dtype=np.uint8)),
        CompressedImage(HEADER, "jpeg", np.arange(7, dtype=np.uint8)),
        CameraInfo(HEADER, 2, 3, "plumb_bob", np.zeros(5), np.eye(3).ravel(), np.eye(3).ravel(), np.zeros(12)),
        Imu(HEADER, Quaternion(0, 0, 0, 1.0), Vector3(1.0, 2, 3), Vector3(4.0, 5, 6)),
        Joy(HEADER, [0.5, -1.0], [0, 1]),
        PointCloud2(HEADER, 1, 2, (PointField("x", 0, 7, 1),), False, 4, 8, np.arange(8, dtype=np.uint8), True),
        POSE,
        PoseStamped(HEADER, POSE),
        TWIST,
        TwistStamped(HEADER, TWIST),
        TransformStamped(HEADER, "tip", Vector3(1.0, 2.0, 3.0), Quaternion(0, 0, 0, 1.0)),
        TFMessage((TransformStamped(HEADER, "tip", Vector3(1.0, 2.0, 3.0), Quaternion(0, 0, 0, 1.0)),)),
        JointTrajectory(HEADER, ("a",), (JointTrajectoryPoint(1_500_000_000, [1.0], [2.0], [3.0]),)),
        DiagnosticArray(HEADER, (DiagnosticStatus(1, "x", "y", "z", (KeyValue("k", "v"),)),)),
    ]
    examples |= {type(each).__name__: each for each in many}
    for name in ("RobotStatus", "ModelAnswer"):
        examples[name] = _default(MESSAGE_TYPES[f"ibrobot_msgs/msg/{name}"])
    return examples


def _default(cls):
    if cls.__name__ == "ModelAnswer":
        times = {"observed_ns": 1_700_000_000_000_000_001, "step_ns": 50_000_000}
        texts = dict.fromkeys(("model", "server", "weights", "prompt", "outcome", "error"), "text")
        numbers = {"request": 3, "latency_ms": 1.5, "infer_ms": 2.5, "queue_ms": 0.5}
        return cls(HEADER, **times, **texts, **numbers, joint_names=("a", "b"), actions=[1.0, 2.0])
    return cls(HEADER, "mini", "teleop", active_executors=("a",), faults=("one",), episode=2)


EXAMPLES = made()


def test_there_is_an_example_of_every_type():
    assert {each.ros_type for each in EXAMPLES.values()} == set(MESSAGE_TYPES)


def test_every_type_is_equal_both_ways(start, peer):
    """The bytes on the wire are ours, ROS reads in them what it wrote, and we read in its bytes what we wrote."""
    run = start("ros.subscribe=" + str({f"/in/{name}": each.ros_type for name, each in EXAMPLES.items()}))
    queues = {name: run.session.bus.subscribe(f"/in/{name}") for name in EXAMPLES}
    for name, example in EXAMPLES.items():
        qos = "sensor_data" if name in ("Image", "CompressedImage", "PointCloud2", "Imu") else "default"
        ours = encode(example).hex()
        theirs = peer.ask("canonical", type=example.ros_type, raw=ours)
        received = None
        while received is None:  # the first ones come before publisher and subscriber know of one another
            peer.ask("publish", topic=f"/in/{name}", type=example.ros_type, raw=theirs, qos=qos)
            received = queues[name].get(0.2)
        assert encode(received.message).hex() == ours, name
        peer.ask("subscribe", topic=f"/out/{name}", type=example.ros_type, qos=qos)
        taken: list[Any] = []
        while not taken:
            run.session.bus.publish(f"/out/{name}", example)
            taken = peer.ask("take", topic=f"/out/{name}", timeout_s=0.1)
        got = taken[0][1]
        assert got.startswith(ours), name
        # Not their bytes: between fields and behind them, ROS leaves some of what its memory had.
        assert peer.ask("text", type=example.ros_type, raw=got) == peer.ask("text", type=example.ros_type, raw=theirs)


def test_joint_states_come_with_their_stamps_and_the_clock(start, peer):
    run = start()
    queue = run.session.bus.subscribe("/joint_states", 100_000)
    peer.ask("subscribe", topic="/joint_states", type="sensor_msgs/msg/JointState")
    peer.ask("subscribe", topic="/clock", type="rosgraph_msgs/msg/Clock", qos="sensor_data")
    got = [raw for _, raw in peer.ask("take", topic="/joint_states", count=50)]
    sent = [encode(each.message).hex() for each in queue.drain()]
    seen = [raw for raw in got if raw in sent]
    assert len(seen) == len(got)
    assert sent[sent.index(seen[0]) :][: len(seen)] == seen, "one is missing, or out of order"
    assert len(peer.ask("take", topic="/clock", count=20)) >= 20


def test_latched_topics_reach_late_subscribers(start, peer):
    run = start()
    run.session.bus.publish("/robot_description", String("<robot/>"), latched=True)
    run.session.bus.publish("/tf_static", EXAMPLES["TFMessage"], latched=True)
    for topic, type_name in (("/robot_description", "std_msgs/msg/String"), ("/tf_static", "tf2_msgs/msg/TFMessage")):
        assert peer.ask("await_topic", topic=topic)
        peer.ask("subscribe", topic=topic, type=type_name, qos="latched")
        assert len(peer.ask("take", topic=topic)) == 1


def test_names_get_the_namespace(start, peer):
    start("ros.namespace=lab/one")
    assert peer.ask("await_topic", topic="/lab/one/joint_states")
    outcome = peer.ask(
        "follow",
        action="/lab/one/arm_trajectory/follow_joint_trajectory",
        joints=["pan", "lift", "roll"],
        points=[[0.3, [0.1] * 3, [0.0] * 3]],
    )
    assert outcome["status"] == "SUCCEEDED"


def test_only_listed_topics_are_published(start, peer):
    start("ros.publish=[/joint_states]", "ros.clock=false")
    assert peer.ask("await_topic", topic="/joint_states")
    topics = peer.ask("topics")
    assert not {"/diagnostics", "/robot_status", "/clock"} & set(topics)


@pytest.mark.parametrize("trouble", ["another type", "nothing that can be read"])
def test_wrong_messages_are_named(start, peer, caplog, trouble):
    run = start("ros.subscribe={/lamp: std_msgs/msg/Bool}")
    if trouble == "another type":
        peer.ask(
            "publish", topic="/lamp", type="std_msgs/msg/String", raw="00010000" + "01000000" + "00", qos="latched"
        )
        expected = "/lamp: node peer publishes std_msgs/msg/String, not std_msgs/msg/Bool"
    else:
        peer.ask("publish", topic="/lamp", type="std_msgs/msg/Bool", raw="00010000")
        expected = "cannot be decoded"
    until(lambda: expected in caplog.text)
    assert not run.session.faults


def test_a_type_with_other_fields_is_left_out(start, peer, caplog, monkeypatch):
    """IB-Robot's `ibrobot_msgs` has a RobotStatus of its own; here, it is ours that differs."""
    monkeypatch.setattr("ibrobot_ros.topics.fields_of", lambda name: ["data", "more"] if name.endswith("Bool") else [])
    run = start("ros.subscribe={/lamp: std_msgs/msg/Bool}")
    run.session.bus.publish("/light", Bool(True))
    for topic in ("/lamp", "/light"):
        expected = f"{topic}: not in ROS: std_msgs/msg/Bool has other fields in this ROS: data"
        until(lambda expected=expected: expected in caplog.text)
    assert not {"/lamp", "/light"} & set(peer.ask("topics"))


NO_EVENTS = """\
import rclpy.event_handler as handler

def without(*, matched=None, kind=handler.PublisherEventCallbacks, **others):
    return kind(**others)

handler.PublisherEventCallbacks = without
"""


@pytest.mark.parametrize("events", [True, False], ids=["events", "lost events"])
@pytest.mark.parametrize("first", ["run", "subscriber"])
def test_pictures_reach_a_plain_subscriber_in_an_environment_of_its_own(start, tmp_path, monkeypatch, first, events):
    """Also if no event tells the node that it is there."""
    if not events:
        (tmp_path / "patches").mkdir()
        (tmp_path / "patches/sitecustomize.py").write_text(NO_EVENTS)
        monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path / "patches"), os.environ["PYTHONPATH"]]))
    picture = Image(HEADER, 48, 64, "rgb8", 192, np.zeros(48 * 192, np.uint8))
    root = Path(PYTHON).absolute().parent.parent
    environment = {
        "PATH": os.environ["PATH"], "HOME": str(tmp_path), "AMENT_PREFIX_PATH": str(root),
        "LD_LIBRARY_PATH": str(root / "lib"), "ROS_DOMAIN_ID": str(DOMAIN),
    }  # fmt: skip
    command = [PYTHON, str(HERE / "stranger.py"), "/camera/top/image_raw", "5"]
    run = start() if first == "run" else None
    if run is not None:
        run.session.bus.publish("/camera/top/image_raw", picture)
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as stranger:
        try:
            assert stranger.stdout is not None
            assert stranger.stdout.readline() == "ready\n"
            run = run or start()
            bus = run.session.bus

            def ended() -> bool:
                bus.publish("/camera/top/image_raw", picture)
                return stranger.poll() is not None

            until(ended)
            assert stranger.stdout.read() == "(64, 48)\n"
        finally:
            stranger.kill()
    assert "subscribers /camera/top/image_raw" in run.ros.counts
    assert run.ros.counts["sent /camera/top/image_raw"] >= 5

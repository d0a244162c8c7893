"""A recorded episode in a real ROS 2: every message is read, compared and played by ROS's own code.

    python -m venv ros2 && ros2/bin/pip install ros-jazzy-rclpy ros-jazzy-rmw-fastrtps-cpp ros-jazzy-std-msgs \
        ros-jazzy-sensor-msgs mcap rosbags pyyaml
    ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST ros2/bin/python benchmarks/ros2_tools.py EPISODE

Runs where `rclpy` is, without ibrobot. The mcap library reads the episode with its checksums, and rosbags reads it too,
without a warning. rclpy decodes each message and encodes it again, to as many bytes and the same values (only ROS's
padding has no set value). Then the messages, as they are in the bag, are published, and a subscription takes each of
them. The counts must be those of metadata.yaml, the types' hashes those that ROS offers. Exits with 1 otherwise.
"""

from __future__ import annotations

import importlib
import sys
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

import rclpy
import yaml
from mcap.reader import make_reader
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.highlevel import AnyReader

INFORMATION = "rosbag2_bagfile_information"


def message_class(type_: str) -> Any:
    """ROS's class of a type."""
    package, _, name = type_.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), name)


def bag_messages(path: Path) -> list[tuple[str, str, bytes]]:
    """Topic, type and CDR of every message, in order."""
    found = []
    for file in sorted(path.glob("*.mcap")):
        with file.open("rb") as stream:
            for schema, channel, message in make_reader(stream, validate_crcs=True).iter_messages():
                assert schema is not None
                found.append((channel.topic, schema.name, message.data))
    return found


def same(type_: str, one: bytes, other: bytes) -> bool:
    """Whether two encoded messages have one length and the same values."""
    decoded = (deserialize_message(cdr, message_class(type_)) for cdr in (one, other))
    return len(one) == len(other) and next(decoded) == next(decoded)


class Played:
    """A topic, published and subscribed to by one node."""

    def __init__(self, node: Any, topic: str, type_: str) -> None:
        self.topic = topic
        self._node = node
        self._type = type_
        self._came: list[bytes] = []
        qos = QoSProfile(depth=10)
        self._publisher = node.create_publisher(message_class(type_), topic, qos)
        self._subscription = node.create_subscription(message_class(type_), topic, self._came.append, qos, raw=True)

    def hash(self) -> str:
        """The type's hash, as ROS offers it."""
        while not (offered := self._node.get_publishers_info_by_topic(self.topic)):
            rclpy.spin_once(self._node, timeout_sec=0.1)
        return str(offered[0].topic_type_hash)

    def play(self, cdr: bytes) -> bool:
        """Publish a message; whether it came as it was sent."""
        self._came.clear()
        self._publisher.publish(cdr)
        for _ in range(50):
            rclpy.spin_once(self._node, timeout_sec=0.1)
            if self._came:
                return same(self._type, cdr, self._came[0])
        return False


def main(path: Path) -> int:
    facts = yaml.safe_load((path / "metadata.yaml").read_text())[INFORMATION]
    stated = {each["topic_metadata"]["name"]: each for each in facts["topics_with_message_count"]}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        messages = bag_messages(path)
        with AnyReader([path]) as reader:
            by_rosbags = Counter(connection.topic for connection, _, _ in reader.messages())
    counts = Counter(topic for topic, _, _ in messages)
    wrong = [
        f"{topic}: {counts[topic]} messages, metadata.yaml says {each['message_count']}"
        for topic, each in stated.items()
        if counts[topic] != each["message_count"]
    ]
    if by_rosbags != counts:
        wrong.append(f"rosbags finds {dict(by_rosbags)}, mcap {dict(counts)}")
    rclpy.init()
    node = rclpy.create_node("ibrobot_ros2_tools")
    played = {topic: Played(node, topic, each["topic_metadata"]["type"]) for topic, each in stated.items()}
    for topic, each in stated.items():
        offered = played[topic].hash()
        if offered != each["topic_metadata"]["type_description_hash"]:
            wrong.append(f"{topic}: type hash {each['topic_metadata']['type_description_hash']}, ROS has {offered}")
    for number, (topic, type_, cdr) in enumerate(messages):
        again = serialize_message(deserialize_message(cdr, message_class(type_)))
        if not same(type_, cdr, again):
            wrong.append(f"{topic}, message {number}: ROS encodes it otherwise")
        if not played[topic].play(cdr):
            wrong.append(f"{topic}, message {number}: was not received as it was sent")
    node.destroy_node()
    rclpy.shutdown()
    print("\n".join(wrong[:20] or [f"{topic}: {count} messages, as ROS has them" for topic, count in counts.items()]))
    print("FAILED" if wrong else "passed")
    return int(bool(wrong))


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    sys.exit(main(Path(sys.argv[1])))

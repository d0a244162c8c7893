"""`metadata.yaml` of a rosbag2 directory, version 9, and the QoS that goes with a topic."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import attrs
import yaml
from ibrobot_ros2 import type_hash

METADATA = "metadata.yaml"
INFORMATION = "rosbag2_bagfile_information"
RECORD = "rosbag2"
RECORD_KEY = "serialized_metadata"
"""Name and key of the metadata record that has the same within an MCAP file."""
OUTCOME = "outcome"
DROPPED = "dropped"
"""Keys that the recorder adds to `custom_data`: a word, and JSON topic -> number of messages."""
MISSING = "missing"
"""Key that a repair adds: JSON topic -> messages that the recorder wrote and that could not be read any more."""

_FOR_EVER = {"sec": 9223372036, "nsec": 854775807}

MARKED = "marked"
"""Key that says that a person set the outcome afterwards."""


@attrs.define
class Counted:
    """Messages of a file."""

    count: int = 0
    start_ns: int = 0
    end_ns: int = 0

    def add(self, stamp_ns: int) -> None:
        """Count a message received at `stamp_ns` [ns]."""
        self.start_ns = stamp_ns if self.count == 0 else min(self.start_ns, stamp_ns)
        self.end_ns = stamp_ns if self.count == 0 else max(self.end_ns, stamp_ns)
        self.count += 1


@attrs.frozen
class Topic:
    """A topic as the bag has it."""

    name: str
    type: str
    latched: bool
    definition: str = ""
    """`ros2msg` or `ros2idl` text, of a topic that is copied from a bag that has it; else ROS 2's own."""
    hash: str = ""
    """Of the type so defined; empty where the text cannot be read."""

    def type_hash(self) -> str:
        """As rosbag2 writes it; empty where it is not known."""
        return self.hash if self.definition else type_hash(self.type)


class _Text(str):
    """Text that is quoted, so that no reader takes it for a number or a boolean."""

    __slots__ = ()


class _Dumper(yaml.SafeDumper):
    """Safe YAML, with `_Text`."""


_Dumper.add_representer(_Text, lambda dumper, text: dumper.represent_scalar("tag:yaml.org,2002:str", text, style='"'))


def offered_qos(latched: bool) -> list[dict[str, Any]]:
    """The QoS profiles of a topic's publishers."""
    profile = {
        "history": "keep_last", "depth": 1 if latched else 10, "reliability": "reliable",
        "durability": "transient_local" if latched else "volatile",
        "deadline": dict(_FOR_EVER), "lifespan": dict(_FOR_EVER), "liveliness": "automatic",
        "liveliness_lease_duration": dict(_FOR_EVER), "avoid_ros_namespace_conventions": False,
    }  # fmt: skip
    return [profile]


def information(
    files: Mapping[str, Counted], topics: Mapping[Topic, int], custom: Mapping[str, str], start_ns: int
) -> dict[str, Any]:
    """What `metadata.yaml` says of a bag.

    Args:
        files: file name -> its messages, in order.
        topics: topic -> number of messages.
        custom: `custom_data`.
        start_ns: when the episode began [ns], for a bag without messages.
    """
    total = Counted()
    for counted in files.values():
        if counted.count:
            total.add(counted.start_ns)
            total.add(counted.end_ns)
    begin_ns = total.start_ns if total.count else start_ns
    return {
        "version": 9,
        "storage_identifier": "mcap",
        "duration": {"nanoseconds": total.end_ns - total.start_ns},
        "starting_time": {"nanoseconds_since_epoch": begin_ns},
        "message_count": sum(topics.values()),
        "topics_with_message_count": [
            {"topic_metadata": _topic(topic), "message_count": count}
            for topic, count in sorted(topics.items(), key=lambda item: item[0].name)
        ],
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": list(files),
        "files": [
            {
                "path": name,
                "starting_time": {"nanoseconds_since_epoch": counted.start_ns if counted.count else start_ns},
                "duration": {"nanoseconds": counted.end_ns - counted.start_ns},
                "message_count": counted.count,
            }
            for name, counted in files.items()
        ],
        "custom_data": quoted(custom),
        "ros_distro": "jazzy",
    }


def _topic(topic: Topic) -> dict[str, Any]:
    return {
        "name": topic.name, "type": topic.type, "serialization_format": "cdr",
        "offered_qos_profiles": offered_qos(topic.latched), "type_description_hash": topic.type_hash(),
    }  # fmt: skip


def quoted(custom: Mapping[str, str]) -> dict[str, str]:
    """`custom_data` as texts, whatever they look like."""
    return {_Text(key): _Text(value) for key, value in custom.items()}


def dump(document: dict[str, Any] | Sequence[Any]) -> str:
    """YAML of plain data, in the order given."""
    return yaml.dump(document, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=2**31)


def write_metadata(directory: Path, facts: dict[str, Any]) -> None:
    """Write `metadata.yaml` whole or not at all, and onto the disk.

    Raises:
        OSError: when it cannot be written.
    """
    temporary = directory / f".{METADATA}"
    with temporary.open("w", encoding="utf-8") as file:
        file.write(dump({INFORMATION: facts}))
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(directory / METADATA)
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)

"""`metadata.yaml` of a rosbag2 directory, version 9, and the QoS of topics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import attrs
import yaml
from ibrobot_provenance.files import replace_file
from ibrobot_ros2 import type_hash

METADATA = "metadata.yaml"
INFORMATION = "rosbag2_bagfile_information"
RECORD = "rosbag2"
RECORD_KEY = "serialized_metadata"
"""Name and key of the equivalent metadata record in an MCAP file."""
OUTCOME = "outcome"
"""Key of `custom_data` with the outcome."""
STATED = "stated_outcome"
"""Key of the outcome that was stated of an episode whose end is missing: it was lost, cut off, or never written."""
DROPPED = "dropped"
"""Key of `custom_data`: JSON, topic -> number of lost messages."""
FAULTS = "faults"
"""Key of `custom_data`: faults and emergency stops during the episode, as a JSON list; missing without any."""
MISSING = "missing"
"""Key that a repair adds: JSON, topic -> number of recorded messages that could not be read."""

_FOR_EVER = {"sec": 9223372036, "nsec": 854775807}

MARKED = "marked"
"""Key of episodes whose outcome was set by hand."""


@attrs.define
class Counted:
    """Message count and time span of a file."""

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
    """A topic in a bag."""

    name: str
    type: str
    latched: bool
    definition: str = ""
    """`ros2msg` or `ros2idl` definition of a topic copied from a bag; otherwise ROS 2's own is used."""
    hash: str = ""
    """Hash of the type with that definition; empty if the definition cannot be parsed."""

    def type_hash(self) -> str:
        """The type hash in rosbag2's format; empty if unknown."""
        return self.hash if self.definition else type_hash(self.type)


class _Text(str):
    """Text to be quoted, so that readers do not parse it as a number or boolean."""

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
    """The content of a bag's `metadata.yaml`.

    Args:
        files: file name -> its messages, in order.
        topics: topic -> number of messages.
        custom: `custom_data`.
        start_ns: start of the episode [ns], for a bag without messages.
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
        "name": topic.name,
        "type": topic.type,
        "serialization_format": "cdr",
        "offered_qos_profiles": offered_qos(topic.latched),
        "type_description_hash": topic.type_hash(),
    }


def quoted(custom: Mapping[str, str]) -> dict[str, str]:
    """`custom_data` with all values quoted as text."""
    return {_Text(key): _Text(value) for key, value in custom.items()}


def dump(document: dict[str, Any] | Sequence[Any]) -> str:
    """YAML of plain data, in its order."""
    return yaml.dump(document, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=2**31)


def write_metadata(directory: Path, info: dict[str, Any]) -> None:
    """Write `metadata.yaml` atomically, and sync it to the disk.

    Raises:
        OSError: if it cannot be written.
    """
    replace_file(directory / METADATA, dump({INFORMATION: info}))

"""Against a real ROS 2 Jazzy: what it serialised (`make_jazzy.py`) is read, and written again byte by byte."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ibrobot_ros2 import decode, encode, type_hash
from ibrobot_ros2.convert import encoder
from ibrobot_ros2.definitions import standard_types

from ibrobot_core.api import MESSAGE_TYPES

JAZZY = json.loads((Path(__file__).parent / "jazzy.json").read_text())
NOT_THERE = {
    "tf2_msgs/msg/TFMessage",
    "ibrobot_msgs/msg/RobotStatus",
    "ibrobot_msgs/msg/ModelAnswer",
    "ibrobot_msgs/msg/AudioBlock",
}
"""Types that its packages from wheels do not have."""


def test_all_types_are_compared():
    assert JAZZY.keys() == MESSAGE_TYPES.keys() - NOT_THERE


@pytest.mark.parametrize("name", JAZZY)
def test_the_type_hash_is_its_own(name):
    assert type_hash(name) == JAZZY[name]["hash"]


def written(name, message):
    """Our bytes behind the encapsulation, and which of them are written rather than skipped for alignment."""
    types = standard_types()
    convert, entry = encoder(name, types)(message), types.get_msgdef(name)
    buffers = [bytearray([filler]) * (len(encode(message)) - 4) for filler in (0, 0xFF)]
    for buffer in buffers:
        entry.serialize_cdr_le(memoryview(buffer), 0, convert, types)
    zeros, ones = (np.frombuffer(buffer, np.uint8) for buffer in buffers)
    return zeros, zeros == ones


@pytest.mark.parametrize("name", JAZZY)
@pytest.mark.parametrize("length", range(4))
def test_its_bytes_are_read_and_written_again(name, length):
    theirs = bytes.fromhex(JAZZY[name]["cdr"][length])
    message = decode(name, theirs)
    ours = bytes(encode(message))
    zeros, is_written = written(name, message)
    assert ours[:2] == theirs[:2]
    assert ours[4:] == zeros.tobytes()
    # What it skips for alignment has whatever was in memory, and at times there is more of it at the end.
    body = np.frombuffer(theirs, np.uint8)[4 : len(ours)]
    assert zeros[is_written].tolist() == body[is_written].tolist()
    assert 0 <= len(theirs) - len(ours) <= 16


def test_values_arrive():
    rng = np.random.default_rng(0)
    message: Any = decode("std_msgs/msg/Int32", bytes.fromhex(JAZZY["std_msgs/msg/Int32"]["cdr"][0]))
    assert message.data == rng.integers(1, 100)
    texts = JAZZY["sensor_msgs/msg/JointState"]["cdr"]
    states: list[Any] = [decode("sensor_msgs/msg/JointState", bytes.fromhex(text)) for text in texts]
    names = [state.name for state in states]
    assert [len(name) for name in names] == [0, 1, 2, 3]
    assert any("€" in text for name in names for text in name)

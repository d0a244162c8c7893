"""Composing: messages of which the contract takes the same values again, and what it cannot know is not made up."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from ibrobot_lerobot.compose import Composer

from ibrobot_core.api import ActionPart, Contract, ContractError, Feature, ObservationPart
from ibrobot_core.app import Align, FrameAssembler
from ibrobot_core.contract.image import ENCODINGS
from ibrobot_core.schema import ImageSpec
from ibrobot_core.selection import Selection

STAMP_NS = 5_000_000_000
JOINTS = "sensor_msgs/msg/JointState"
SELECTS = [
    (JOINTS, ["position.a", "position.b"]),
    (JOINTS, ["velocity.b", "position.a", "effort.b"]),
    ("sensor_msgs/msg/Imu", ["angular_velocity"]),
    ("sensor_msgs/msg/Imu", ["orientation.w", "linear_acceleration.z"]),
    ("sensor_msgs/msg/Joy", ["axes"]),
    ("sensor_msgs/msg/Joy", ["axes.2", "axes.0"]),
    ("std_msgs/msg/Float32MultiArray", []),
    ("std_msgs/msg/Float64MultiArray", ["data.1", "data.0"]),
    ("geometry_msgs/msg/Pose", []),
    ("geometry_msgs/msg/PoseStamped", ["pose.position.x"]),
    ("geometry_msgs/msg/Twist", ["linear.x", "angular"]),
    ("geometry_msgs/msg/TransformStamped", ["translation"]),
]


def part(key: str, topic: str, type_: str, select: list[str]) -> ObservationPart:
    selection = Selection(type_, select)
    feature = Feature("float32", (selection.size,), selection.names)
    stamp = (
        "header"
        if (type_.split("/", maxsplit=1)[0] != "std_msgs" and "Stamped" in type_) or "sensor" in type_
        else "receive"
    )
    return ObservationPart(key, topic, type_, selection.paths, None, Align("hold", stamp), feature)


def again(contract: Contract, values: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The frame of the messages made of `values`."""
    made = Composer(contract)(values, STAMP_NS)
    assembler = FrameAssembler(contract)
    for topic, message in made.items():
        assembler.take(topic, message, STAMP_NS)
    return dict(assembler.frame(STAMP_NS).values)


@pytest.mark.parametrize(("type_", "select"), SELECTS)
@given(chosen=st.data())
def test_every_selection_is_put_back(type_: str, select: list[str], chosen: st.DataObject):
    contract = Contract(30.0, (part("state", "/topic", type_, select),), ())
    size = contract.observations["state"].shape[0]
    length = chosen.draw(st.integers(1, 6)) if size < 0 else size
    value = chosen.draw(arrays.arrays(np.float32, length, elements=st.floats(-1e6, 1e6, width=32)))
    np.testing.assert_array_equal(again(contract, {"state": value})["state"], value)


def test_parts_of_a_key_and_keys_of_a_topic_share_messages():
    contract = Contract(
        30.0,
        (
            part("state", "/joints", JOINTS, ["position.a", "position.b"]),
            part("state", "/extra", "std_msgs/msg/Float32MultiArray", []),
            part("speed", "/joints", JOINTS, ["velocity.b"]),
        ),
        (),
    )
    values = {"state": np.array([1, 2, 7, 8, 9], np.float32), "speed": np.array([3], np.float32)}
    made = Composer(contract)(values, STAMP_NS)
    assert made.keys() == {"/joints", "/extra"}
    joints: Any = made["/joints"]
    assert joints.name == ("a", "b")
    np.testing.assert_array_equal(joints.velocity, [np.nan, 3])
    assert joints.effort.size == 0
    frame = again(contract, values)
    for key, value in values.items():
        np.testing.assert_array_equal(frame[key], value)


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "mono8", "16UC1", "32FC1"])
def test_images(encoding: str):
    dtype, channels = ENCODINGS[encoding]
    feature = Feature("image", (-1, -1, channels))
    camera = ObservationPart("top", "/top", "sensor_msgs/msg/Image", (), ImageSpec(None, encoding), Align(), feature)
    picture = np.random.default_rng(1).integers(0, 200, (6, 8, channels)).astype(dtype)
    np.testing.assert_array_equal(again(Contract(30.0, (camera,), ()), {"top": picture})["top"], picture)


@pytest.mark.parametrize(
    ("array", "encoding", "fault"),
    [
        (np.zeros((2, 2, 4), np.uint8), "rgb8", r"uint8 of shape \(H, W, 3\), got uint8 of shape \(2, 2, 4\)"),
        (np.zeros((2, 2, 1), np.float64), "32FC1", r"float32 of shape \(H, W, 1\), got float64"),
    ],
)
def test_images_of_another_encoding_are_refused(array: np.ndarray, encoding: str, fault: str):
    feature = Feature("image", (-1, -1, ENCODINGS[encoding][1]))
    camera = ObservationPart("top", "/top", "sensor_msgs/msg/Image", (), ImageSpec(None, encoding), Align(), feature)
    with pytest.raises(ContractError, match=fault):
        Composer(Contract(30.0, (camera,), ()))({"top": array}, STAMP_NS)


def test_actions_go_to_their_executors_topics():
    actions = tuple(
        ActionPart(name, f"/{name}", "std_msgs/msg/Float64MultiArray", "hold", joints)
        for name, joints in (("arm", ("a", "b")), ("gripper", ("c",)))
    )
    made: Any = Composer(Contract(30.0, (), actions))({"action": np.array([1, 2, 3], np.float32)}, STAMP_NS)
    assert {topic: message.data.tolist() for topic, message in made.items()} == {"/arm": [1, 2], "/gripper": [3]}
    with pytest.raises(ContractError, match=r"an action has 3 values \(a, b, c\), got the shape \(2,\)"):
        Composer(Contract(30.0, (), actions))({"action": np.zeros(2)}, STAMP_NS)


def test_only_topics_whose_keys_are_there_are_made():
    contract = Contract(30.0, (part("state", "/a", JOINTS, ["position.a"]), part("x", "/b", JOINTS, ["effort.a"])), ())
    assert Composer(contract)({"x": np.zeros(1)}, STAMP_NS).keys() == {"/b"}
    assert Composer(contract).keys({"/a"}) == {"state"}


def test_numbers_that_nothing_selects_are_not_made_up():
    contract = Contract(30.0, (part("state", "/imu", "sensor_msgs/msg/Imu", ["angular_velocity"]),), ())
    message: Any = Composer(contract)({"state": np.ones(3)}, STAMP_NS)["/imu"]
    assert np.isnan([message.orientation.w, message.linear_acceleration.x]).all()
    buttons = Contract(30.0, (part("state", "/joy", "sensor_msgs/msg/Joy", ["buttons.1"]),), ())
    with pytest.raises(ContractError, match=r"buttons: elements that no path selects are unknown"):
        Composer(buttons)({"state": np.ones(1)}, STAMP_NS)


def test_vectors_of_another_length_are_refused():
    contract = Contract(30.0, (part("state", "/a", JOINTS, ["position.a"]),), ())
    with pytest.raises(ContractError, match="state has 1 values by the contract, got 2"):
        Composer(contract)({"state": np.zeros(2)}, STAMP_NS)


def test_whole_arrays_that_cannot_be_distinguished_are_refused():
    both = part("state", "/joy", "sensor_msgs/msg/Joy", ["axes", "buttons"])
    with pytest.raises(ContractError, match="the position of axes, buttons in the vector is unknown"):
        Composer(Contract(30.0, (both,), ()))
    arrays_ = [part("state", topic, "std_msgs/msg/Float32MultiArray", []) for topic in ("/a", "/b")]
    with pytest.raises(ContractError, match="lengths of 2 whole arrays cannot be distinguished"):
        Composer(Contract(30.0, tuple(arrays_), ()))


def test_foreign_messages_are_refused():
    touch = ObservationPart("touch", "/touch", "lamp_msgs/msg/Touch", ("x",), None, Align(), Feature("float32", (1,)))
    with pytest.raises(ContractError, match="touch: cannot make a lamp_msgs/msg/Touch"):
        Composer(Contract(30.0, (touch,), ()))
    command = ActionPart("arm", "/lamp/command", "lamp_msgs/msg/Command", "hold", ("a",), ("joints.0.target",))
    with pytest.raises(
        ContractError, match=r"action: cannot make a .* for /lamp/command, because the action is foreign"
    ):
        Composer(Contract(30.0, (), (command,)))

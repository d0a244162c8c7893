"""Selection by dotted path: joints by name in any order, elements by number, and asking for what is not there."""

from __future__ import annotations

import re
from typing import Any, ClassVar

import attrs
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ibrobot_core.errors import ContractError
from ibrobot_core.messages import (
    Bool,
    Float64MultiArray,
    Header,
    Imu,
    Int8,
    Int32,
    Int32MultiArray,
    JointState,
    JointTrajectory,
    JointTrajectoryPoint,
    Joy,
    Message,
    Pose,
    PoseStamped,
    Quaternion,
    TransformStamped,
    Twist,
    TwistStamped,
    Vector3,
)
from ibrobot_core.selection import Selection

NAMES = ("shoulder_pan", "left.elbow", "gripper", "joint/4")
QUATERNION = Quaternion(0.1, 0.2, 0.3, 0.9)


@settings(deadline=None)
@given(
    order=st.permutations((*NAMES, "extra")),
    later=st.permutations((*NAMES, "extra")),
    wanted=st.lists(st.tuples(st.sampled_from(["position", "velocity", "effort"]), st.sampled_from(NAMES)), min_size=1),
)
def test_joints_go_by_name_whatever_the_senders_order(
    order: list[str], later: list[str], wanted: list[tuple[str, str]]
) -> None:
    fields = ("position", "velocity", "effort")
    worth = {(field, name): i + k / 8 for i, field in enumerate(fields) for k, name in enumerate((*NAMES, "extra"))}
    selection = Selection("sensor_msgs/msg/JointState", [f"{field}.{name}" for field, name in wanted])
    for names in (order, later, order):
        values = [[worth[field, name] for name in names] for field in fields]
        vector = selection(JointState(Header(), tuple(names), *values))
        assert vector.dtype == np.float32
        np.testing.assert_array_equal(vector, [worth[pair] for pair in wanted])
    assert selection.size == len(wanted)


IMU = Imu(Header(), QUATERNION, Vector3(1, 2, 3), Vector3(4, 5, 6))
JOY = Joy(Header(), axes=[0.5, -0.5], buttons=[1, 0, 1])
POSE = Pose(Vector3(1, 2, 3), QUATERNION)


@pytest.mark.parametrize(
    ("message", "select", "expected"),
    [
        (IMU, [], [0.1, 0.2, 0.3, 0.9, 1, 2, 3, 4, 5, 6]),
        (IMU, ["linear_acceleration.z", "orientation"], [6, 0.1, 0.2, 0.3, 0.9]),
        (JOY, [], [0.5, -0.5, 1, 0, 1]),
        (JOY, ["buttons.2", "buttons.1", "axes.1"], [1, 0, -0.5]),
        (POSE, [], [1, 2, 3, 0.1, 0.2, 0.3, 0.9]),
        (POSE, ["position.y"], [2]),
        (PoseStamped(Header(), POSE), [], [1, 2, 3, 0.1, 0.2, 0.3, 0.9]),
        (PoseStamped(Header(), POSE), ["pose.position", "pose.orientation.w"], [1, 2, 3, 0.9]),
        (Twist(Vector3(1, 2, 3), Vector3(4, 5, 6)), [], [1, 2, 3, 4, 5, 6]),
        (TwistStamped(Header(), Twist(Vector3(1, 2, 3), Vector3(4, 5, 6))), ["twist.linear.z"], [3]),
        (TransformStamped(Header(), "tip", Vector3(1, 2, 3), QUATERNION), [], [1, 2, 3, 0.1, 0.2, 0.3, 0.9]),
        (Float64MultiArray([1.5, 2.5, 3.5]), [], [1.5, 2.5, 3.5]),
        (Float64MultiArray([1.5, 2.5, 3.5]), ["data.2", "data.0"], [3.5, 1.5]),
        (Int32MultiArray([7, 8]), ["data", "data.1"], [7, 8, 8]),
        (Bool(True), [], [1]),
        (Int32(-3), ["data"], [-3]),
        (Int8(-1), [], [-1]),
    ],
)
def test_paths_of_other_messages(message: Message, select: list[str], expected: list[float]) -> None:
    selection = Selection(message.ros_type, select)
    np.testing.assert_array_equal(selection(message), np.array(expected, dtype=np.float32))
    assert selection.size in (-1, len(expected))
    assert len(selection.names) == max(selection.size, 0)


def test_names_are_lerobots_for_joints_and_paths_for_the_rest() -> None:
    joints = Selection("sensor_msgs/msg/JointState", ["position.a", "velocity.a", "effort.b"])
    assert joints.names == ("a.pos", "a.vel", "b.eff")
    assert Selection("geometry_msgs/msg/Pose", ["position"]).names == ("position.x", "position.y", "position.z")
    assert Selection("std_msgs/msg/Float64MultiArray", ["data.3"]).names == ("data.3",)


def test_joint_states_without_a_select_are_the_robots_positions() -> None:
    selection = Selection("sensor_msgs/msg/JointState", (), ("b", "a"))
    assert selection.paths == ("position.b", "position.a")
    np.testing.assert_array_equal(selection(JointState(Header(), ("a", "b"), [1, 2])), [2, 1])


@pytest.mark.parametrize(
    ("type_name", "select", "message"),
    [
        ("sensor_msgs/msg/JointStat", [], "unknown message type 'sensor_msgs/msg/JointStat', did you mean"),
        ("sensor_msgs/msg/JointState", ["positon.pan"], "JointState has no field 'positon', did you mean 'position'"),
        ("sensor_msgs/msg/JointState", ["position"], "name them, e.g. position.shoulder_pan"),
        ("sensor_msgs/msg/JointState", ["name"], "'name' leads to no number of JointState"),
        ("sensor_msgs/msg/Imu", ["orientation.q"], "Quaternion has no field 'q'; available: x, y, z, w"),
        ("sensor_msgs/msg/Imu", ["orientation.x.y"], "leads to no number"),
        ("sensor_msgs/msg/Joy", ["axes.first"], "select an element by number, e.g. axes.0"),
        ("sensor_msgs/msg/Joy", ["axes.-1"], "select an element by number, e.g. axes.0"),
        ("std_msgs/msg/String", ["data"], "'data' leads to no number of String"),
        ("std_msgs/msg/String", [], "String needs a select"),
        ("tf2_msgs/msg/TFMessage", ["transforms.0"], "leads to no number"),
        ("tf2_msgs/msg/TFMessage", ["transforms.first"], "transforms is a list; select an element by number"),
        ("tf2_msgs/msg/TFMessage", ["transforms.0.rotatoin.x"], "has no field 'rotatoin', did you mean 'rotation'"),
        ("trajectory_msgs/msg/JointTrajectory", ["points.0.positions"], "is an array; select an element by number"),
    ],
)
def test_paths_that_lead_nowhere_are_refused_at_once(type_name: str, select: list[str], message: str) -> None:
    with pytest.raises(ContractError, match=message):
        Selection(type_name, select)


@pytest.mark.parametrize(
    ("received", "select", "message"),
    [
        (JointState(Header(), ("a", "b"), [1, 2]), ["position.c"], "no joint 'c'; it has: a, b"),
        (JointState(Header(), ("a", "b"), [1, 2]), ["velocity.a"], "has 2 names of joints, but 0 in velocity"),
        (JointState(Header(), ("a", "b"), [1, 2, 3]), ["position.a"], "has 2 names of joints, but 3 in position"),
        (Float64MultiArray([1.0, 2.0]), ["data.2"], "has 2 elements in data, element 2 is asked for"),
    ],
)
def test_messages_that_lack_what_is_selected_are_refused(received: Message, select: list[str], message: str) -> None:
    with pytest.raises(ContractError, match=message):
        Selection(received.ros_type, select)(received)


TOUCH = "lamp_msgs/msg/Touch"


@attrs.frozen
class Tag:
    number: int
    name: str


@attrs.frozen
class Touch(Message):
    """As a codec makes it of a definition that a bag brought."""

    ros_type: ClassVar[str] = TOUCH
    header: Header
    pressure: Any
    tags: tuple[Tag, ...]
    hot: bool = False


@given(
    pressure=st.lists(st.floats(width=32, allow_nan=False), min_size=1, max_size=5),
    numbers=st.lists(st.integers(-1000, 1000), min_size=1, max_size=3),
    hot=st.booleans(),
)
def test_paths_lead_into_messages_of_foreign_types(pressure: list[float], numbers: list[int], hot: bool) -> None:
    paths = [f"pressure.{i}" for i in range(len(pressure))] + [f"tags.{i}.number" for i in range(len(numbers))]
    selection = Selection(TOUCH, [*paths, "hot"])
    assert (selection.size, selection.names) == (len(paths) + 1, (*paths, "hot"))
    message = Touch(Header(), np.array(pressure, np.float32), tuple(Tag(n, "x") for n in numbers), hot)
    vector = selection(message)
    assert vector.dtype == np.float32
    np.testing.assert_array_equal(vector, np.array([*pressure, *numbers, hot], np.float32))


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("presure.0", "'presure.0': the message has no field 'presure'; available: header, pressure, tags, hot"),
        ("pressure", "'pressure' leads to 2 elements; select one by number"),
        ("pressure.2", "pressure has 2 elements, element 2 is asked for"),
        ("pressure.x", "'pressure.x' leads to 2 elements; select one by number"),
        ("pressure.0.x", "'pressure.0.x' leads to no number"),
        ("tags.0", "'tags.0' leads to no number; available: number, name"),
        ("tags.0.name", "'tags.0.name' leads to no number"),
        ("tags.0.nmae", "'tags.0.nmae': tags.0 has no field 'nmae'; available: number, name"),
    ],
)
def test_paths_that_lead_to_no_number_of_a_foreign_message(path: str, message: str) -> None:
    touch = Touch(Header(), np.zeros(2), (Tag(1, "x"),))
    with pytest.raises(ContractError, match=re.escape(message)):
        Selection(TOUCH, [path])(touch)


def test_unknown_type_needs_paths() -> None:
    with pytest.raises(ContractError, match="unknown message type 'lamp_msgs/msg/Touch'"):
        Selection(TOUCH)


def test_paths_lead_into_lists_of_parts_of_known_types() -> None:
    points = tuple(JointTrajectoryPoint(i, positions=[i, i + 0.5]) for i in range(2))
    selection = Selection("trajectory_msgs/msg/JointTrajectory", ["points.1.positions.1", "points.0.positions.0"])
    assert selection.size == 2
    np.testing.assert_array_equal(selection(JointTrajectory(Header(), ("a", "b"), points)), [1.5, 0.0])
    whole = Selection("tf2_msgs/msg/TFMessage", ["transforms.0.translation"])
    assert whole.names == tuple(f"transforms.0.translation.{axis}" for axis in "xyz")
    with pytest.raises(ContractError, match="points has 0 elements, element 1 is asked for"):
        selection(JointTrajectory(Header(), ("a", "b"), ()))
    with pytest.raises(ContractError, match="leads to no number of JointTrajectory"):
        Selection("trajectory_msgs/msg/JointTrajectory", ["points"])

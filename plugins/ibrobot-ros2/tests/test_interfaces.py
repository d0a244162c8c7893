"""Services and actions of ROS 2: hashes as ROS Jazzy has them, and requests as plain data."""

from __future__ import annotations

import pytest
from ibrobot_ros2 import CodecError, decode, type_hash
from ibrobot_ros2.interfaces import action_type, from_cdr, interfaces, service_type, to_cdr

# Of the files PACKAGE/KIND/NAME.json that the packages of ROS Jazzy install.
HASHES = {
    "action_msgs/srv/CancelGoal": "573d8b0a534451d7bc2ac8c5ffde8ac14b8593b7001175d0cd6516dcbeb8689a",
    "control_msgs/action/FollowJointTrajectory_FeedbackMessage":
        "80398fcb9674a79081a9906e2ccf0c804dd7cb15e22e362e606ee87186beab71",
    "control_msgs/action/FollowJointTrajectory_GetResult":
        "e3ceb38e3e1867c8dc0f46014df26e90eb93422f27e9e97f936e07f94be4bc8b",
    "control_msgs/action/FollowJointTrajectory_SendGoal":
        "b13789dddc325a7a962825c45e28c77d37237ec129dd0c34dc5994562938c57f",
    "control_msgs/action/GripperCommand_FeedbackMessage":
        "392ff03fcd872f9dc2405cbeb2897fcf011ad9998458b6aa85c603b8a49e431d",
    "control_msgs/action/GripperCommand_GetResult":
        "7e60a7606063d4a2728d21badac099e68b734a196ac3ab42d1d4c668eb0bb3cd",
    "control_msgs/action/GripperCommand_SendGoal":
        "6bf8cc4ce80cd499e7dd3258c03c50c3fa6672b469ff8355339ef1df77fcd212",
    "control_msgs/action/ParallelGripperCommand_FeedbackMessage":
        "c61f4cf99d06c5a3e24bed17c2910bdf66a30d89461e2ac7b5fd538a34b022cc",
    "control_msgs/action/ParallelGripperCommand_GetResult":
        "e4c7f0e8a831ce5625ed20abcd13796406d945f92ebc7ad5972e0b0d29b381bd",
    "control_msgs/action/ParallelGripperCommand_SendGoal":
        "567c37373fed1260adbe047415688c73e4f3e94b2e3982761ecc71fd63d710a7",
    "ibrobot_msgs/action/DispatchInfer_FeedbackMessage":
        "4c012d4d10b4cec7343da79b3424c22e6ab6184ba77572658d334fc6f83ab428",
    "ibrobot_msgs/action/DispatchInfer_GetResult": "42e50b38ce7c90d4ec1b4255e2d0c761d3a0f6446288a14c479d3da9bb12d58f",
    "ibrobot_msgs/action/DispatchInfer_SendGoal": "729b599f3daeaede3ac331641a9a7bd69d856090084cb9db1199502c5aeb05d8",
    "ibrobot_msgs/action/RecordEpisode_FeedbackMessage":
        "e52cb04e80702e201776db3d7e6564fc5b0146d8993fc74d291334b9c5c8e7ae",
    "ibrobot_msgs/action/RecordEpisode_GetResult": "63ee7464c7c4806429348e5a5b6758164c70255442361265b3397367c7592fe5",
    "ibrobot_msgs/action/RecordEpisode_SendGoal": "cfc69b39a60ae39d402bf28d90b5a5551d93bfc9423c72924a3d7db032493581",
    "ibrobot_msgs/srv/MoveToConfiguration": "06c5351baf255a8e4a390e72af937603b1cc1b614aba078b19c7339425a082da",
    "ibrobot_msgs/srv/MoveToPose": "a3ca142ae8c253221e34abfce186bb33b1bd26399872d6033b18417f24203fad",
    "rcl_interfaces/srv/GetParameters": "bf9803d5c74cf989a5de3e0c2e99444599a627c7ff75f97b8c05b01003675cbc",
    "rcl_interfaces/srv/ListParameters": "3e6062bfbb27bfb8730d4cef2558221f51a11646d78e7bb30a1e83afac3aad9d",
    "rcl_interfaces/srv/SetParameters": "56eed9a67e169f9cb6c1f987bc88f868c14a8fc9f743a263bc734c154015d7e0",
    "std_srvs/srv/SetBool": "abe9e4bb6b41b40e6789712c00ec8871923e089af3f667a79992a428cff2da0a",
    "std_srvs/srv/Trigger": "eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f",
}  # fmt: skip


def test_hashes_are_those_of_ros():
    services = [service_type(name) for name in interfaces("srv")]
    for action in map(action_type, interfaces("action")):
        services += [action.send_goal, action.get_result]
        assert type_hash(action.feedback) == f"RIHS01_{HASHES[action.feedback]}"
    assert {each.name: each.hash for each in services} == {
        name: f"RIHS01_{digest}" for name, digest in HASHES.items() if not name.endswith("_FeedbackMessage")
    }


def test_plain_data_comes_back():
    request = action_type("control_msgs/action/FollowJointTrajectory").send_goal.request
    points = [{"positions": [1.0, -0.5], "time_from_start": {"sec": 1, "nanosec": 5}}]
    goal = {
        "trajectory": {"joint_names": ["a", "b"], "points": points},
        "goal_tolerance": [{"name": "a", "position": 1}],
    }
    data = to_cdr(request, {"goal_id": {"uuid": list(range(16))}, "goal": goal})
    found = from_cdr(request, data)
    assert found["goal_id"]["uuid"] == list(range(16))
    (point,) = found["goal"]["trajectory"]["points"]
    assert (point["positions"], point["velocities"]) == ([1.0, -0.5], [])
    assert found["goal"]["goal_tolerance"] == [{"name": "a", "position": 1.0, "velocity": 0.0, "acceleration": 0.0}]
    message: object = decode(request, data).goal.trajectory.points[0].time_from_start_ns  # type: ignore[attr-defined]
    assert message == 1_000_000_005


def test_a_request_without_fields_is_one_byte():
    request = service_type("std_srvs/srv/Trigger").request
    assert to_cdr(request, {}) == b"\x00\x01\x00\x00\x00"
    assert from_cdr(request, b"\x00\x01\x00\x00\x00") == {}


@pytest.mark.parametrize(
    ("value", "reason"),
    [
        ({"command": {"positon": 1.0}}, "command.positon: unknown; the fields are position, max_effort"),
        ({"command": 3}, "command: expected a mapping with position, max_effort, got 3"),
        ({"command": {"position": "wide"}}, "command.position: expected a number, got 'wide'"),
        ({"command": {"position": True}}, "command.position: expected a number, got True"),
    ],
)
def test_data_that_does_not_fit_is_named_by_its_field(value, reason):
    action_type("control_msgs/action/GripperCommand")
    with pytest.raises(CodecError) as error:
        to_cdr("control_msgs/action/GripperCommand_Goal", value)
    assert str(error.value) == reason


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"uuid": [1] * 15}, "uuid: needs 16 values, got 15"),
        ({"uuid": [256] * 16}, r"uuid\[0\]: 256 is beyond 0 to 255"),
        ({"uuid": [0.5] * 16}, r"uuid\[0\]: expected a whole number, got 0.5"),
        ({"uuid": "x"}, "uuid: expected a list, got 'x'"),
    ],
)
def test_arrays_are_checked(values, reason):
    with pytest.raises(CodecError, match=reason):
        to_cdr("unique_identifier_msgs/msg/UUID", values)


def test_unknown_types_and_damaged_bytes_are_errors():
    for find, name in ((service_type, "std_srvs/srv/Triger"), (action_type, "x"), (service_type, "../srv/..")):
        with pytest.raises(CodecError, match="is not defined here; defined are "):
            find(name)
    for data in (b"", b"\x00\x01\x00", b"\xff" * 40):
        with pytest.raises(CodecError):
            from_cdr(service_type("std_srvs/srv/SetBool").response, data)

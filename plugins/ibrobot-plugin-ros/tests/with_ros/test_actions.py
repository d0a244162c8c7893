"""FollowJointTrajectory and GripperCommand, sent by a client of rclpy's."""

from __future__ import annotations

import random

import pytest
from ibrobot_ros2.goals import TrajectoryCode

from .conftest import scaled

ACTION, GRIP = "/arm_trajectory/follow_joint_trajectory", "/gripper_action/gripper_cmd"
ARM = ["pan", "lift", "roll"]


def to(*positions, at=0.6):
    return [[at, list(positions), [0.0] * len(positions)]]


def test_goals_succeed_with_feedback(start, peer):
    run = start()
    made = random.Random(1)
    for _ in range(scaled(100)):
        target = [made.uniform(-0.4, 0.4) for _ in ARM]
        outcome = peer.ask("follow", action=ACTION, joints=ARM, points=to(*target))
        assert (outcome["status"], outcome["error_code"]) == ("SUCCEEDED", 0), outcome
        assert outcome["feedback"] >= 5
        assert run.session.measured().position[:3] == pytest.approx(target, abs=0.03)
    run.check_steps()


def test_joints_in_another_order(start, peer):
    run = start()
    outcome = peer.ask("follow", action=ACTION, joints=["roll", "pan", "lift"], points=to(0.3, 0.1, 0.2))
    assert outcome["status"] == "SUCCEEDED"
    assert run.session.measured().position[:3] == pytest.approx([0.1, 0.2, 0.3], abs=0.03)


def test_cancels_at_random_times(start, peer):
    run = start()
    made = random.Random(2)
    for i in range(scaled(100)):
        side = 1.0 if i % 2 else -1.0
        outcome = peer.ask(
            "follow",
            action=ACTION,
            joints=ARM,
            points=to(side, side, side, at=1.5),
            then="cancel",
            after_s=made.uniform(0.0, 0.5),
        )
        assert (outcome["status"], outcome["error_code"]) == ("CANCELED", 0), outcome
    run.check_steps()


def test_a_new_goal_replaces_the_old_at_random_times(start, peer):
    run = start()
    made = random.Random(3)
    for i in range(scaled(100)):
        side = 0.6 if i % 2 else -0.6
        peer.ask(
            "follow",
            action=ACTION,
            joints=ARM,
            points=to(side, side, side, at=1.2),
            then="leave",
            after_s=made.uniform(0.0, 0.3),
        )
    last = peer.ask("follow", action=ACTION, joints=ARM, points=to(0.0, 0.0, 0.0, at=1.0))
    assert last["status"] == "SUCCEEDED"
    for outcome in peer.ask("outcomes"):
        assert (outcome["status"], outcome["error_code"]) == ("ABORTED", -1), outcome
        assert "replaced" in outcome["error_string"]
    run.check_steps()


REFUSED = {
    "partial joints": ({"joints": ["pan", "lift"], "points": to(0.1, 0.1)}, "INVALID_JOINTS"),
    "unknown joint": ({"joints": ["pan", "lift", "elbow"]}, "INVALID_JOINTS"),
    "beyond limits": ({"points": to(9.0, 0.1, 0.1)}, "INVALID_GOAL"),
    "NaN": ({"points": to(float("nan"), 0.1, 0.1)}, "INVALID_GOAL"),
    "no points": ({"points": []}, "INVALID_GOAL"),
    "times that fall": ({"points": [*to(0.1, 0.1, 0.1), *to(0.2, 0.2, 0.2, at=0.4)]}, "INVALID_GOAL"),
    "in the past": ({"stamp_ns": 1_000_000_000}, "OLD_HEADER_TIMESTAMP"),
}


def test_results_of_refused_goals_say_why(start, peer, caplog):
    start()
    for name, (changes, code) in REFUSED.items():
        caplog.clear()
        goal = {"action": ACTION, "joints": ARM, "points": to(0.1, 0.1, 0.1), **changes}
        ended = peer.ask("follow", **goal)
        assert (ended["status"], ended["error_code"]) == ("ABORTED", TrajectoryCode[code]), name
        assert ended["error_string"], name


def test_tolerances_end_a_goal_with_their_codes(start, peer):
    start()
    far = to(1.5, 1.5, 1.5, at=2.0)
    path = peer.ask("follow", action=ACTION, joints=ARM, points=far, path_tolerance=[("pan", 1e-9)])
    assert (path["status"], path["error_code"]) == ("ABORTED", -4), path
    goal = peer.ask(
        "follow",
        action=ACTION,
        joints=ARM,
        points=to(0.0, 0.0, 0.0, at=2.0),
        goal_tolerance=[("pan", 1e-12)],
        goal_time=0.01,
    )
    assert (goal["status"], goal["error_code"]) == ("ABORTED", -5), goal


def test_an_emergency_stop_ends_a_goal(start, peer):
    run = start()
    peer.ask("follow", action=ACTION, joints=ARM, points=to(1.0, 1.0, 1.0, at=3.0), after_s=0.5, then="leave")
    run.session.emergency_stop()
    (outcome,) = peer.ask("outcomes")
    assert (outcome["status"], outcome["error_code"]) == ("ABORTED", -1)
    refused = peer.ask("follow", action=ACTION, joints=ARM, points=to(0.0, 0.0, 0.0))
    assert (refused["status"], "before a reset" in refused["error_string"]) == ("ABORTED", True)
    run.check_steps()


def test_the_gripper_grasps_an_object(start, peer):
    start()
    opened = peer.ask("grip", action=GRIP, position=0.9)
    assert (opened["status"], opened["reached_goal"], opened["stalled"]) == ("SUCCEEDED", True, False)
    grasped = peer.ask("grip", action=GRIP, position=0.05)
    assert (grasped["status"], grasped["reached_goal"], grasped["stalled"]) == ("SUCCEEDED", False, True)
    assert grasped["position"] == pytest.approx(0.3, abs=0.01)
    assert peer.ask("grip", action=GRIP, position=-3.0) == {"accepted": False}


def test_a_parallel_gripper_grasps_an_object(start, peer):
    start("ros.gripper_action=ParallelGripperCommand")
    opened = peer.ask("grip_parallel", action=GRIP, name=["grip"], position=[0.9])
    assert (opened["status"], opened["reached_goal"], opened["stalled"]) == ("SUCCEEDED", True, False)
    grasped = peer.ask("grip_parallel", action=GRIP, name=[], position=[0.05])
    assert (grasped["status"], grasped["reached_goal"], grasped["stalled"]) == ("SUCCEEDED", False, True)
    assert grasped["state"] == [["grip"], [pytest.approx(0.3, abs=0.01)]]
    for wrong in ({"name": ["other"], "position": [0.5]}, {"name": ["grip"], "position": [0.5, 0.6]}):
        assert peer.ask("grip_parallel", action=GRIP, **wrong) == {"accepted": False}


def test_canceling_the_arm_leaves_the_gripper(start, peers, peer):
    from .conftest import Peer

    start()
    other = Peer()
    peers.append(other)
    other.send("grip", action=GRIP, position=0.9)
    canceled = peer.ask("follow", action=ACTION, joints=ARM, points=to(0.5, 0.5, 0.5), after_s=0.05, then="cancel")
    assert canceled["status"] == "CANCELED"
    assert other.answer()["status"] == "SUCCEEDED"


def test_a_client_killed_in_motion(start, peers, peer):
    """As on ros2_control, the goal goes on; a goal of the next client replaces it."""
    from .conftest import Peer

    run = start()
    peer.ask("follow", action=ACTION, joints=ARM, points=to(0.8, 0.8, 0.8, at=2.0), after_s=0.3, then="leave")
    peer.process.kill()
    other = Peer()
    peers.append(other)
    outcome = other.ask("follow", action=ACTION, joints=ARM, points=to(0.2, 0.2, 0.2))
    assert outcome["status"] == "SUCCEEDED"
    assert not run.session.faults
    run.check_steps()

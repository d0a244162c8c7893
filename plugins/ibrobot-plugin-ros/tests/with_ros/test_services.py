"""Services of a run, called by clients of rclpy's."""

from __future__ import annotations

import threading
from types import NoneType

import pytest

from ibrobot_core.app import NoRequest, Service

from .conftest import Peer, scaled, until

TRIGGER = "std_srvs/srv/Trigger"


def test_modes_reset_and_stop(start, peer):
    run = start()
    assert peer.ask("call", name="/set_mode/idle", type=TRIGGER) == [[True, ""]]
    assert run.session.mode == "idle"
    assert peer.ask("call", name="/estop", type=TRIGGER) == [[True, ""]]
    until(lambda: run.session.faults)
    ((refused, why),) = peer.ask("call", name="/set_mode/ros", type=TRIGGER)
    assert not refused
    assert "refused before a reset" in why
    ((done, then),) = peer.ask("call", name="/reset", type=TRIGGER)
    assert done
    assert "mode idle starts over" in then
    assert not run.session.faults


def test_calls_of_four_clients(start, peers):
    start()
    count = scaled(1000) // 4
    for _ in range(4):
        peers.append(Peer())
    for each in peers:
        each.send("call", name="/set_mode/idle", type=TRIGGER, count=count)
    assert [len(each.answer()) for each in peers] == [count] * 4


def test_a_stop_does_not_wait_for_slow_calls(start, peers):
    run = start()
    begun, ends = threading.Event(), threading.Event()

    def answer(request):
        begun.set()
        ends.wait(30.0)

    run.session.bus.serve(Service("/slow", NoRequest, NoneType), answer)
    for _ in range(2):
        peers.append(Peer())
    slow, stopper = peers
    slow.send("call", name="/slow", type=TRIGGER)
    assert begun.wait(30.0)
    assert stopper.ask("call", name="/estop", type=TRIGGER) == [[True, ""]]
    until(lambda: run.session.faults)
    ends.set()
    assert slow.answer() == [[True, ""]]


def test_services_of_a_mode_appear_with_it(start, peer):
    start()
    assert "/planning/cancel" not in peer.ask("services")
    peer.ask("call", name="/set_mode/plan", type=TRIGGER)
    assert peer.ask("call", name="/planning/cancel", type=TRIGGER) == [[True, ""]]


def test_an_episode_is_recorded_by_services(start, peer, tmp_path):
    start("recording={type: mcap, topics: all}", by_operator=True)
    assert peer.ask("call", name="/record_episode/start", type=TRIGGER)[0][0]
    assert peer.ask("call", name="/record_episode/stop", type=TRIGGER)[0][0]
    assert (tmp_path / "episodes/default/episodes/episode_000001").is_dir()


def test_the_gateway_of_ib_robot_moves_joints(start, peer):
    run = start(mode="plan")
    goal = {"target_joint_state": {"name": ["pan", "lift"], "position": [0.3, -0.2]}}
    kind = "ibrobot_msgs/srv/MoveToConfiguration"
    service = "/moveit_gateway/move_to_configuration"
    assert peer.ask("call", name=service, type=kind, request=goal) == [[True, ""]]
    assert run.session.measured().position[:2] == pytest.approx([0.3, -0.2], abs=0.03)
    goal["target_joint_state"]["position"] = [9.0, 0.0]
    ((moved, why),) = peer.ask("call", name=service, type=kind, request=goal)
    assert not moved
    assert "pan" in why
    run.check_steps()

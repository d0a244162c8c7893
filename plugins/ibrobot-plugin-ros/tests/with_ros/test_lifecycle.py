"""A node that dies, is stopped, is flooded or comes late: named, and the control loop does not notice."""

from __future__ import annotations

import os
import signal
import time

import pytest

from .conftest import SHARE, Peer, until

ACTION = "/arm_trajectory/follow_joint_trajectory"
ARM = ["pan", "lift", "roll"]


def pass_time(run, duration_s):
    """Let the run go on."""
    deadline = time.monotonic() + duration_s
    while time.monotonic() < deadline:
        run.session.watch_states().get(0.05)


def test_a_node_killed_in_motion(start, peer, peers, caplog):
    run = start()
    peer.ask("follow", action=ACTION, joints=ARM, points=[[5.0, [1.0] * 3, [0.0] * 3]], after_s=0.5, then="leave")
    before = run.ros.pid
    os.kill(before, signal.SIGKILL)
    until(lambda: "killed by SIGKILL" in caplog.text)
    assert "arm_trajectory holds" in caplog.text
    until(lambda: run.ros.pid not in (None, before))
    held = run.session.state.command.copy()
    peers.append(Peer())  # the old one still sends to the dead node, until DDS gives it up after 20 s
    outcome = peers[-1].ask("follow", action=ACTION, joints=ARM, points=[[0.5, [0.0] * 3, [0.0] * 3]])
    assert outcome["status"] == "SUCCEEDED"
    assert abs(held[0]) < 0.5, "it went on without a node"
    assert not run.session.faults
    run.check_steps()


def test_a_stopped_node_is_named_and_its_goals_end(start, peer, caplog):
    run = start()
    peer.ask("follow", action=ACTION, joints=ARM, points=[[20.0, [1.0] * 3, [0.0] * 3]], after_s=0.5, then="leave")
    os.kill(run.ros.pid, signal.SIGSTOP)
    try:
        until(lambda: "does not answer" in run.ros.state)
        assert "arm_trajectory holds" in caplog.text
    finally:
        os.kill(run.ros.pid, signal.SIGCONT)
    until(lambda: "does not answer" not in run.ros.state)
    (outcome,) = peer.ask("outcomes")
    assert (outcome["status"], outcome["error_code"]) == ("ABORTED", -1)
    assert not run.session.faults


def test_a_flood_is_dropped_and_counted(start, peer, caplog):
    run = start("ros.subscribe={/lamp: std_msgs/msg/Bool}", "ros.rate_hz=100")
    queue = run.session.bus.subscribe("/lamp", 1_000_000)
    peer.send("publish", topic="/lamp", type="std_msgs/msg/Bool", raw="0001000001", count=scaled_flood())
    until(lambda: run.ros.counts.get("dropped /lamp", 0) > 100)
    assert "faster than rate_hz, 100" in caplog.text
    outcome = peer.answer()
    assert outcome == scaled_flood()
    assert 0 < len(queue.drain()) < scaled_flood()
    assert not run.session.faults


def scaled_flood():
    return max(3000, round(50_000 * SHARE))


def test_a_peer_that_comes_late_and_goes(start, peers):
    run = start()
    for _ in range(2):
        peer = Peer()
        outcome = peer.ask("follow", action=ACTION, joints=ARM, points=[[0.3, [0.1] * 3, [0.0] * 3]])
        assert outcome["status"] == "SUCCEEDED"
        peer.close()
    assert not run.session.faults


@pytest.mark.parametrize("trouble", ["busy", "stopped"])
def test_the_loop_is_as_punctual_as_before(start, peer, trouble):
    """The loop's own report says so."""
    run = start("ros.subscribe={/lamp: std_msgs/msg/Bool}")
    if trouble == "busy":
        peer.send("publish", topic="/lamp", type="std_msgs/msg/Bool", raw="0001000001", count=5000)
        pass_time(run, 1.0)
        peer.answer()
    else:
        os.kill(run.ros.pid, signal.SIGSTOP)
        pass_time(run, 1.0)
        os.kill(run.ros.pid, signal.SIGCONT)
    assert not run.session.faults
    ticks = [tick for tick, _ in run.commands]
    assert ticks == sorted(ticks)
    assert len(ticks) > 50

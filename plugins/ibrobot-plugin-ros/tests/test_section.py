# mypy: disable-error-code="operator"
"""The node beside a run, with a fake in place of ROS."""

from __future__ import annotations

import queue
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import attrs
import numpy as np
import pytest
from ibrobot_ros.options import RosOptions
from ibrobot_ros.section import RosNode
from ibrobot_ros2 import decode, encode
from ibrobot_ros2.offers import TRIGGER, Offer
from ibrobot_testing import stand_in
from ibrobot_testing.section import SectionSuite, make_session

from ibrobot_core.api import Bool, Header, Image, JointState, MissingDependency, String
from ibrobot_core.app import ComponentFailed, Session

from . import fake_node

PATIENCE_S = 10.0


class TestRosNode(SectionSuite):
    @pytest.fixture(autouse=True)
    def _python(self, tmp_path):
        self.python = fake_node.write(tmp_path)

    def component(self, session):
        return RosNode(RosOptions(python=str(self.python)), session)


@attrs.frozen
class Part:
    node: RosNode
    session: Session
    folder: Path

    def frames(self, op):
        """The frames of a kind so far, but those of the node's own status."""
        found = [(head, body) for head, body in fake_node.frames(self.folder) if head["op"] == op]
        return [(head, body) for head, body in found if "/diagnostics" not in head.get("topic", "")]


def until(ready):
    deadline = time.monotonic() + PATIENCE_S
    while not ready():
        assert time.monotonic() < deadline, "it did not happen"
        time.sleep(0.005)


@pytest.fixture
def started(tmp_path):
    """Starts a node beside a run in real time."""
    made = []

    def start(behaviour="", **options):
        session = make_session()
        session.request = attrs.evolve(session.request, lockstep=False)
        node = RosNode(RosOptions(python=str(fake_node.write(tmp_path, behaviour)), **options), session)
        made.append(node)
        node.start()
        return Part(node, session, tmp_path)

    yield start
    for node in made:
        node.stop()


def sent(*frames):
    return fake_node.sends(ping=list(frames))


def test_topics_get_the_profiles_of_ros(started):
    part = started()
    bus = part.session.bus
    bus.publish("/joint_states", JointState(Header(5), ("a",), [1.0]))
    bus.publish("/robot_description", String("<robot/>"), latched=True)
    bus.publish("/camera/image_raw", Image(Header(6), 1, 1, "mono8", 1, np.zeros(1, np.uint8)))
    until(lambda: len(part.frames("publisher")) == 3)
    assert {head["topic"]: (head["type"], head["qos"]) for head, _ in part.frames("publisher")} == {
        "/joint_states": ("sensor_msgs/msg/JointState", "default"),
        "/robot_description": ("std_msgs/msg/String", "latched"),
        "/camera/image_raw": ("sensor_msgs/msg/Image", "sensor_data"),
    }
    until(lambda: len(part.frames("message")) == 2)
    (state, body), _ = part.frames("message")
    assert state["topic"] == "/joint_states"
    decoded = decode("sensor_msgs/msg/JointState", body)
    assert isinstance(decoded, JointState)
    assert decoded.header.stamp_ns == 5


def test_images_are_sent_only_to_subscribers(started):
    part = started(sent(({"op": "matched", "topic": "/image", "subscribers": 1}, b"")))
    image = Image(Header(6), 1, 1, "mono8", 1, np.zeros(1, np.uint8))
    part.session.bus.publish("/image", image)
    until(lambda: part.node.topics._subscribers)
    assert not part.frames("message")
    part.session.bus.publish("/image", image)
    until(lambda: part.frames("message"))


def test_messages_of_ros_come_on_the_bus(started):
    frame = ({"op": "message", "topic": "/one/lamp"}, encode(Bool(True)).tobytes())
    part = started(sent(frame), namespace="one", subscribe={"/lamp": "std_msgs/msg/Bool"})
    queue = part.session.bus.subscribe("/lamp")
    received = queue.get(PATIENCE_S)
    assert received is not None
    assert received.message == Bool(True)
    part.session.bus.publish("/lamp", Bool(False))
    part.session.bus.publish("/other", Bool(False))
    until(lambda: part.frames("message"))
    assert [head["topic"] for head, _ in part.frames("message")] == ["/one/other"], "what came from ROS went back"


def test_a_flood_is_counted_and_named(started, caplog):
    frames = (
        ({"op": "dropped", "topic": "/lamp", "count": 40}, b""),
        ({"op": "dropped", "topic": "/lamp", "count": 2}, b""),
    )
    part = started(sent(*frames), subscribe={"/lamp": "std_msgs/msg/Bool"})
    until(lambda: part.node.counts.get("dropped /lamp") == 42)
    assert caplog.text.count("faster than rate_hz") == 1


def test_damaged_messages_are_counted_and_named(started, caplog):
    part = started(sent(({"op": "message", "topic": "/lamp"}, b"\x00")), subscribe={"/lamp": "std_msgs/msg/Bool"})
    until(lambda: part.node.counts.get("refused /lamp") == 1)
    assert "a message from ROS was refused" in caplog.text
    assert part.session.failure_text == ""


def test_a_node_that_dies_is_named_and_started_again(started, caplog, monkeypatch):
    monkeypatch.setattr("ibrobot_ros.section._FIRST_WAIT_S", 0.01)
    part = started(sent())
    part.session.bus.publish("/robot_description", String("<robot/>"), latched=True)
    until(lambda: part.frames("message"))
    before = part.node.pid
    part.node._node._process.kill()
    until(lambda: part.node.pid not in (None, before))
    until(lambda: len(part.frames("message")) == 2)  # the new node gets what is latched
    assert "killed by SIGKILL" in caplog.text
    assert part.node.counts["restarts"] == 1
    assert part.session.failure_text == ""
    status = part.session.bus.subscribe("/diagnostics").get(PATIENCE_S)
    assert status is not None
    assert "rmw_none" in status.message.status[0].message


def test_a_silent_node_is_named(started, caplog, monkeypatch):
    monkeypatch.setattr("ibrobot_ros.section._SILENT_S", 0.2)
    monkeypatch.setattr("ibrobot_ros.section._SETUP_S", 0.0)
    part = started("silent")
    until(lambda: "does not answer" in caplog.text)
    assert "does not answer" in part.node.state
    assert part.session.failure_text == ""


def test_no_ros_is_an_error_with_a_remedy(started):
    with pytest.raises(MissingDependency, match="no rclpy") as raised:
        started("missing")
    assert "setup.bash" in str(raised.value.remedy)


def test_a_node_that_dies_at_the_start_says_why(started):
    with pytest.raises(ComponentFailed, match="exit status 3: a library is missing"):
        started("dies")


def test_an_interpreter_that_does_not_exist_is_named(started, tmp_path):
    with pytest.raises(MissingDependency, match=r"ros\.python: no such program: /no/python"):
        RosNode(RosOptions(python="/no/python"), make_session()).start()


def test_messages_that_nobody_takes_in_time_are_counted(started, caplog, monkeypatch):
    monkeypatch.setattr("ibrobot_ros.topics.DEPTH", 2)
    part = started()
    with part.session.bus._lock:  # nobody takes one meanwhile
        for _ in range(5):
            part.session.bus.publish("/lamp", Bool(True))
    until(lambda: part.node.counts.get("lost /lamp") == 3)
    assert caplog.text.count("too slow for its topics") == 1


def test_the_rest_is_sent_at_the_end(started, monkeypatch):
    part = started()
    part.node._ending.set()
    for thread in part.node._threads:
        thread.join()
    for _ in range(5):
        part.session.bus.publish("/lamp", Bool(True))
    part.node.stop()
    assert len(part.frames("message")) == 5


def test_without_further_threads_stops_are_answered_and_other_calls_refused(started, monkeypatch):
    part = started()
    services, calls = part.node._services, []
    part.session.bus.unserve("/estop")
    part.session.bus.serve(stand_in("/estop"), lambda request: calls.append("estop"))
    answers: queue.SimpleQueue[dict[str, object]] = queue.SimpleQueue()
    channel = SimpleNamespace(send=answers.put)
    services._offers = {"/estop": Offer(TRIGGER, "/estop", {}, urgent=True), "/slow": Offer(TRIGGER, "/slow", {})}

    def refuse(thread):
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", refuse)
    for number in range(3):
        services.take_call(channel, {"service": "/slow", "call": number, "request": {}})
        assert "no thread for this call" in answers.get(timeout=PATIENCE_S)["message"]
        services.take_call(channel, {"service": "/estop", "call": number, "request": {}})
        assert answers.get(timeout=PATIENCE_S)["success"] is True
    assert calls == ["estop"] * 3
    monkeypatch.undo()


def test_threads_that_stops_go_through_give_signs_of_life(started):
    part = started()
    assert {pulse.name for pulse in part.session.pulses} == {"calls from ROS", "services for ROS 2 nodes"}
    part.node.stop()
    assert not part.session.pulses

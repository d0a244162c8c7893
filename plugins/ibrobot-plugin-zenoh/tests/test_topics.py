"""Messages between machines, and with ROS 2 nodes of another make: names, types, latched ones, what is unreadable."""

from __future__ import annotations

import importlib.util
import queue
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import zenoh
from ibrobot_ros2 import encode
from ibrobot_zenoh import topics as topics_module
from ibrobot_zenoh.ros2 import Node, SharedTopic, absolute, attachment, ros_type, topic_key, topics_of_tokens

from ibrobot_core.api import Header, Image, Int32, JointState, Message, String, TransportError

from .pair import WAIT_S, client, free_endpoint, router, settle, wait_for

Arrived = queue.SimpleQueue[Message]


def test_messages_arrive_as_they_were():
    endpoint = free_endpoint()
    far, near = router(endpoint), client(endpoint, namespace="robot1")
    arrived = Arrived()
    far.subscribe_messages("/robot1/joint_states", arrived.put)
    far.subscribe_messages("/robot1/top/image", arrived.put)
    settle(near, far)
    states = [JointState(Header(i, "base"), ("pan",), [0.1 * i]) for i in range(3)]
    for state in states:
        near.publish_message("/joint_states", state)
    assert [arrived.get(timeout=WAIT_S) for _ in states] == states
    picture = Image(Header(1, "top"), 480, 640, "rgb8", 1920, np.arange(480 * 1920, dtype=np.uint32).astype(np.uint8))
    near.publish_message("top/image", picture)
    assert arrived.get(timeout=WAIT_S) == picture
    near.close()
    far.close()


def test_the_newest_latched_message_is_there_for_who_comes_later():
    endpoint = free_endpoint()
    near = client(endpoint)  # before there is anybody to connect to
    for text in ("first", "second"):
        near.publish_message("/robot_description", String(text), latched=True)
    far = router(endpoint)
    for text in ("second", "third"):
        arrived = Arrived()
        end = far.subscribe_messages("/robot_description", arrived.put)
        assert arrived.get(timeout=WAIT_S) == String(text)
        near.publish_message("/robot_description", String("third"), latched=True)
        assert arrived.get(timeout=WAIT_S) == String("third")
        end()
    near.close()
    far.close()


def test_topics_are_listed_while_they_are_shared():
    endpoint = free_endpoint()
    far, near, other = router(endpoint), client(endpoint, namespace="lab/robot1"), client(endpoint, domain=7)
    near.publish_message("/count", Int32(1))
    near.publish_message("/description", String(""), latched=True)
    other.publish_message("/elsewhere", Int32(1))
    expected = [
        SharedTopic("/lab/robot1/count", "std_msgs/msg/Int32", 1, 0),
        SharedTopic("/lab/robot1/description", "std_msgs/msg/String", 1, 0),
    ]
    wait_for(lambda: far.shared_topics(WAIT_S) == expected)
    assert near.shared_topics(WAIT_S) == expected
    near.close()
    wait_for(lambda: far.shared_topics(WAIT_S) == [])
    other.close()
    far.close()


def test_what_cannot_be_read_is_passed_over(caplog: pytest.LogCaptureFixture):
    endpoint = free_endpoint()
    far, near = router(endpoint), client(endpoint)
    arrived = Arrived()
    far.subscribe_messages("/text", arrived.put)
    settle(near, far)
    with zenoh.open(raw_config(endpoint)) as stranger:
        for kind in ("std_msgs::msg::dds_::String_", "nobody_msgs::msg::dds_::Unknown_", "nonsense"):
            for payload in (b"", b"\x00\x01", b"\xff" * 100):
                stranger.put(f"0/text/{kind}/RIHS01_x", payload, congestion_control=zenoh.CongestionControl.BLOCK)
        stranger.put("0/text/std_msgs::msg::dds_::String_/Other", bytes(encode(String("good"))))
        assert arrived.get(timeout=WAIT_S) == String("good")
    assert arrived.empty()
    assert caplog.text.count("a message on /text was skipped") == 1
    near.close()
    far.close()


def raw_config(endpoint: str) -> zenoh.Config:
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["{endpoint}"]')
    config.insert_json5("transport/shared_memory/enabled", "false")
    return config


def test_mistakes_are_reported():
    transport = router(free_endpoint(), max_message_size=2000)
    transport.publish_message("/a", Int32(1))
    with pytest.raises(TransportError, match="topic /a carries std_msgs/msg/Int32, not std_msgs/msg/String"):
        transport.publish_message("/a", String(""))
    with pytest.raises(TransportError, match=r"/b: a message of 30.. bytes is larger than max_message_size, 2000"):
        transport.publish_message("/b", String("x" * 3000))
    with pytest.raises(TransportError, match="is not a ROS 2 topic name"):
        transport.subscribe_messages("/a b", print)
    transport.close()
    for topic in ("/a", "/c"):
        with pytest.raises(TransportError, match="closed"):
            transport.publish_message(topic, Int32(1))
    with pytest.raises(TransportError, match="closed"):
        transport.subscribe_messages("/c", print)
    with pytest.raises(TransportError, match="closed"):
        transport.shared_topics(1.0)


def test_a_slow_subscriber_loses_the_oldest(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture):
    monkeypatch.setattr(topics_module, "DEPTH", 2)
    transport = router(free_endpoint())
    begun, release, seen = queue.SimpleQueue[Message](), queue.SimpleQueue[None](), list[Message]()

    def slow(message: Message) -> None:
        begun.put(message)
        release.get(timeout=WAIT_S)
        seen.append(message)

    transport.subscribe_messages("/count", slow)
    transport.publish_message("/count", Int32(0))
    begun.get(timeout=WAIT_S)
    for i in range(1, 6):
        transport.publish_message("/count", Int32(i))
    wait_for(lambda: "a subscriber of /count is too slow" in caplog.text)
    settle(transport, transport)
    for _ in range(3):
        release.put(None)
    wait_for(lambda: len(seen) == 3)
    assert seen == [Int32(0), Int32(4), Int32(5)]
    transport.close()


def test_names_are_those_of_rmw_zenoh():
    """As rmw_zenoh's design document has them."""
    hash_ = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
    assert (
        topic_key(2, "/chatter", "std_msgs/msg/String", hashed=True)
        == f"2/chatter/std_msgs::msg::dds_::String_/{hash_}"
    )
    humble = topic_key(0, "/chatter", "std_msgs/msg/String", hashed=False)
    assert humble == "0/chatter/std_msgs::msg::dds_::String_/TypeHashNotSupported"
    token = Node(2, "aac3178e146ba6f1fc6e6a4085e77f21", "listener").publisher_token(
        10, "/robot/chatter", "std_msgs/msg/String", hashed=True, latched=True
    )
    assert token == (
        "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/10/MP/%/%/listener/%robot%chatter/"
        f"std_msgs::msg::dds_::String_/{hash_}/:1:,1:,:,:,,"
    )
    gid = bytes(range(16))
    expected = b"\x01" + bytes(7) + b"\x02" + bytes(7) + b"\x10" + gid
    assert attachment(1, 2, gid) == expected
    assert ros_type("sensor_msgs::msg::dds_::Image_") == "sensor_msgs/msg/Image"
    assert absolute("joint_states", "/robot1/") == "/robot1/joint_states"


def test_ill_formed_tokens_are_passed_over():
    good = "@ros2_lv/0/1/0/10/MP/%/%/n/%a/std_msgs::msg::dds_::Bool_/RIHS01_x/q"
    listener = good.replace("/10/MP", "/11/MS")
    bad = ["", "@ros2_lv", good.replace("dds_::Bool_", "Bool"), good.replace("MP", "SS"), f"{good}/more"]
    assert topics_of_tokens([good, good, listener, *bad]) == [SharedTopic("/a", "std_msgs/msg/Bool", 1, 1)]


@pytest.mark.skipif(not importlib.util.find_spec("zenoh_ros2_sdk"), reason="needs zenoh-ros2-sdk")
def test_a_ros_2_node_of_another_make_hears_and_is_heard():
    endpoint = free_endpoint()
    far, near = router(endpoint), client(endpoint, namespace="lab")
    arrived = Arrived()
    far.subscribe_messages("/reply", arrived.put)
    near.publish_message("/chatter", String("too early"))
    wait_for(lambda: far.shared_topics(WAIT_S))
    script = Path(__file__).with_name("ros_peer.py")
    with subprocess.Popen(
        [sys.executable, str(script), endpoint.rpartition(":")[2]],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as peer:
        assert peer.stdout is not None
        try:
            assert peer.stdout.readline().split() == ["/lab/chatter", "/reply"]
            expected = SharedTopic("/lab/chatter", "std_msgs/msg/String", 1, 1)
            wait_for(lambda: expected in far.shared_topics(WAIT_S))
            # That it listens may be known at the router before it is here.
            wait_for(lambda: near.publish_message("/chatter", String("hello")) or not arrived.empty())
            assert arrived.get(timeout=WAIT_S) == String("heard hello")
        finally:
            peer.kill()
    near.close()
    far.close()

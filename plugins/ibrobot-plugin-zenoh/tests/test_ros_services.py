"""Services between machines in rmw_zenoh's dialect, and with ROS 2 nodes of another make."""

from __future__ import annotations

import importlib.util
import queue
import subprocess
import sys
import threading
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import zenoh
from ibrobot_ros2 import CodecError
from ibrobot_ros2.interfaces import service_type
from ibrobot_zenoh.network import Reply
from ibrobot_zenoh.ros2 import Node, SharedService, caller_of, service_key, services_of_tokens
from ibrobot_zenoh.transport import ZenohTransport

from ibrobot_core.api import TransportError

from .pair import WAIT_S, client, free_endpoint, router, wait_for
from .test_topics import raw_config

TRIGGER, SET_BOOL = service_type("std_srvs/srv/Trigger"), service_type("std_srvs/srv/SetBool")


def switch(request: dict[str, Any], reply: Reply) -> None:
    reply({"success": request["data"], "message": "naïve"})


def _is_silent(transport: ZenohTransport) -> bool:
    return not transport.shared_services(WAIT_S)


def test_calls_are_answered_both_ways():
    endpoint = free_endpoint()
    far, near = router(endpoint), client(endpoint)
    for server, caller in ((far, near), (near, far)):
        end = server.serve_ros("/lamp/switch", SET_BOOL, switch)
        wait_for(partial(caller.shared_services, WAIT_S))
        for data in (True, False):
            answer = caller.call_ros("/lamp/switch", SET_BOOL, {"data": data}, WAIT_S)
            assert answer == {"success": data, "message": "naïve"}
        end()
        wait_for(partial(_is_silent, caller))
        with pytest.raises(TransportError, match="nobody serves /lamp/switch as std_srvs/srv/SetBool"):
            caller.call_ros("/lamp/switch", SET_BOOL, {"data": True}, WAIT_S)
    with pytest.raises(CodecError, match="data: expected true or false, got 3"):
        near.call_ros("/lamp/switch", SET_BOOL, {"data": 3}, WAIT_S)


def test_an_answer_may_come_later_and_from_another_thread():
    endpoint = free_endpoint()
    far, near = router(endpoint), client(endpoint)
    waiting = queue.SimpleQueue[Reply]()
    far.serve_ros("/slow", TRIGGER, lambda request, reply: waiting.put(reply))
    wait_for(lambda: near.shared_services(WAIT_S))
    answers = queue.SimpleQueue[dict[str, Any]]()
    threads = [
        threading.Thread(target=lambda: answers.put(near.call_ros("/slow", TRIGGER, {}, WAIT_S))) for _ in range(10)
    ]
    for thread in threads:
        thread.start()
    replies = [waiting.get(timeout=WAIT_S) for _ in threads]  # more than there are threads
    for i, reply in enumerate(replies):
        reply({"success": True, "message": str(i)})
    assert sorted(int(answers.get(timeout=WAIT_S)["message"]) for _ in threads) == list(range(10))
    for thread in threads:
        thread.join()
    with pytest.raises(TransportError, match=r"no answer from /slow within 0\.2 s"):
        near.call_ros("/slow", TRIGGER, {}, 0.2)


def test_what_cannot_be_read_is_dropped(caplog: pytest.LogCaptureFixture):
    endpoint = free_endpoint()
    far = router(endpoint)
    far.serve_ros("/lamp/switch", SET_BOOL, switch)
    key = service_key(0, "/lamp/switch", SET_BOOL, hashed=True)
    with zenoh.open(raw_config(endpoint)) as stranger:
        for payload in (None, b"", b"\x00\x01", b"\xff" * 100):
            replies = list(stranger.get(key, payload=payload, attachment=b"short", timeout=WAIT_S))
            assert not [each for each in replies if each.ok is not None]
        (answer,) = stranger.get(key, payload=b"\x00\x01\x00\x00\x01", timeout=WAIT_S)
        assert answer.ok is not None
    assert caplog.text.count("a call of /lamp/switch was dropped") == 4


def test_names_are_those_of_rmw_zenoh():
    """As rmw_zenoh's design document has them."""
    hash_ = "RIHS01_eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f"
    assert service_key(2, "/estop", TRIGGER, hashed=True) == f"2/estop/std_srvs::srv::dds_::Trigger_/{hash_}"
    assert service_key(0, "/estop", TRIGGER, hashed=False).endswith("Trigger_/TypeHashNotSupported")
    token = Node(2, "aac3", "robot").server_token(3, "/lab/estop", TRIGGER, hashed=True)
    assert token == f"@ros2_lv/2/aac3/0/3/SS/%/%/robot/%lab%estop/std_srvs::srv::dds_::Trigger_/{hash_}/::,10:,:,:,,"
    used = token.replace("/SS/", "/SC/").replace("/3/", "/4/")
    assert services_of_tokens([token, used, "x"]) == [SharedService("/lab/estop", "std_srvs/srv/Trigger", 1, 1)]
    assert caller_of(b"too short") == (0, bytes(16))


@pytest.mark.skipif(not importlib.util.find_spec("zenoh_ros2_sdk"), reason="needs zenoh-ros2-sdk")
def test_services_of_a_ros_2_node_of_another_make():
    endpoint = free_endpoint()
    far, near = router(endpoint), client(endpoint)
    near.serve_ros("/ours", SET_BOOL, switch)
    script = Path(__file__).with_name("ros_service_peer.py")
    with subprocess.Popen(
        [sys.executable, str(script), endpoint.rpartition(":")[2], SET_BOOL.hash],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as peer:
        assert peer.stdout is not None
        try:
            assert peer.stdout.readline() == "True naïve\n"
            found = {each.name: each.servers for each in far.shared_services(WAIT_S)}
            assert found == {"/ours": 1, "/theirs": 1}
            for caller in (far, near):
                answer = caller.call_ros("/theirs", SET_BOOL, {"data": True}, WAIT_S)
                assert answer == {"success": True, "message": "heard True"}
        finally:
            peer.kill()

"""`ibrobot service …` beside a router on this machine that serves as a robot does."""

from __future__ import annotations

from typing import Any

import attrs
import pytest
from click.testing import CliRunner
from ibrobot_ros2 import CodecError
from ibrobot_ros2.interfaces import service_type
from ibrobot_ros2.services import Answer, decode_call, encode_answer, endpoint
from ibrobot_testing.command import command_line
from ibrobot_zenoh.commands import network as network_module
from ibrobot_zenoh.options import ZenohOptions
from ibrobot_zenoh.transport import ZenohTransport

from ibrobot_core.api import NotSupported, Payload, TransportError
from ibrobot_core.app import RequestError

from .pair import WAIT_S, free_endpoint, router

service = command_line("service")


@pytest.fixture
def network(monkeypatch: pytest.MonkeyPatch) -> str:
    """A robot that answers with what it was asked."""
    from_options = network_module.options_from

    def options(*arguments: Any) -> ZenohOptions:
        return attrs.evolve(from_options(*arguments), shared_memory=False)

    monkeypatch.setattr(network_module, "options_from", options)
    monkeypatch.setattr(network_module, "_CONNECT_S", WAIT_S)
    address = free_endpoint()
    robot: ZenohTransport = router(address)

    def answer(payload: Payload, sender: str | None) -> bytes:
        call = decode_call(payload)
        if call.service == "/no":
            return encode_answer(Answer("the robot says no", result=False))
        return encode_answer(Answer(["/a", "/b"] if call.service == "/rosapi/services" else call.request))

    robot.serve(endpoint("arm1"), answer)
    switch = service_type("std_srvs/srv/SetBool")
    robot.serve_ros("/arm1/b", switch, lambda request, reply: reply({"success": request["data"], "message": "done"}))
    cancel = service_type("action_msgs/srv/CancelGoal")
    robot.serve_ros("/arm1/x/_action/cancel_goal", cancel, lambda request, reply: None)
    return address


def run(address: str, *arguments: str) -> str:
    result = CliRunner().invoke(service, [*arguments, "--endpoint", address, "--namespace", "arm1"])
    if result.exception is not None:
        raise result.exception
    return result.output


def test_services_are_listed_and_called(network: str):
    assert run(network, "list") == "/a\n/arm1/b\n/b\n"
    assert run(network, "call", "/a", "{x: 1, y: [2.5, home]}") == "x: 1\ny:\n- 2.5\n- home\n"
    assert run(network, "call", "/a", "home") == "home\n"
    assert run(network, "call", "/a", "--text", "5") == "5\n"
    assert run(network, "call", "/a") == ""


def test_services_of_ros_2_are_called_by_their_type(network: str):
    assert run(network, "list", "-t") == "/a\n/arm1/b [std_srvs/srv/SetBool]\n/b\n"
    answer = "success: true\nmessage: done\n"
    assert run(network, "call", "/b", "std_srvs/srv/SetBool", "{data: true}") == answer
    assert run(network, "call", "/b", "std_srvs/srv/SetBool") == answer.replace("true", "false")
    with pytest.raises(CodecError, match="data: expected true or false, got 3"):
        run(network, "call", "/b", "std_srvs/srv/SetBool", "{data: 3}")
    with pytest.raises(
        CodecError, match="'std_srvs/srv/No' is not defined here; defined are action_msgs/srv/CancelGoal"
    ):
        run(network, "call", "/b", "std_srvs/srv/No")
    with pytest.raises(RequestError, match="got 2 words after /b; quote REQUEST"):
        run(network, "call", "/b", "{x:", "1}")


def test_refusals_and_missing_robots_are_errors(network: str):
    with pytest.raises(NotSupported, match="the robot says no"):
        run(network, "call", "/no")
    result = CliRunner().invoke(service, ["show", "/a", "--endpoint", network, "--namespace", "arm2"])
    assert isinstance(result.exception, TransportError)
    assert "nobody serves arm2/services" in str(result.exception)

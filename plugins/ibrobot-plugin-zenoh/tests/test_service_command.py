"""`ibrobot service …` beside a router on this machine that serves as a robot does."""

from __future__ import annotations

from typing import Any

import attrs
import pytest
from click.testing import CliRunner
from ibrobot_ros2.services import Answer, decode_call, encode_answer, endpoint
from ibrobot_zenoh.commands import network as network_module
from ibrobot_zenoh.commands.service import service
from ibrobot_zenoh.options import ZenohOptions
from ibrobot_zenoh.transport import ZenohTransport

from ibrobot_core.api import NotSupported, Payload, TransportError

from .pair import WAIT_S, free_endpoint, router


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
    return address


def run(address: str, *arguments: str) -> str:
    result = CliRunner().invoke(service, [*arguments, "--endpoint", address, "--namespace", "arm1"])
    if result.exception is not None:
        raise result.exception
    return result.output


def test_services_are_listed_and_called(network: str):
    assert run(network, "list") == "/a\n/b\n"
    assert run(network, "call", "/a", "{x: 1, y: [2.5, home]}") == "x: 1\ny:\n- 2.5\n- home\n"
    assert run(network, "call", "/a", "home") == "home\n"
    assert run(network, "call", "/a", "--text", "5") == "5\n"
    assert run(network, "call", "/a") == ""


def test_refusals_and_missing_robots_are_errors(network: str):
    with pytest.raises(NotSupported, match="the robot says no"):
        run(network, "call", "/no")
    result = CliRunner().invoke(service, ["list", "--endpoint", network, "--namespace", "arm2"])
    assert isinstance(result.exception, TransportError)
    assert "nobody serves arm2/services" in str(result.exception)

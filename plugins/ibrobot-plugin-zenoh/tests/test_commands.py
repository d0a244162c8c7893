"""`ibrobot topic …` beside a router on this machine: what they show, count and send, and their errors."""

from __future__ import annotations

import queue
import signal
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from ibrobot_testing import ibrobot_command
from ibrobot_testing.command import command_line
from ibrobot_zenoh.commands import network as network_module
from ibrobot_zenoh.commands.topic import message_from, shown
from ibrobot_zenoh.options import ZenohOptions
from ibrobot_zenoh.transport import ZenohTransport

from ibrobot_core.api import (
    Bool,
    Float64MultiArray,
    Header,
    IbrobotError,
    JointState,
    Message,
    NotSupported,
    Options,
    Robot,
)
from ibrobot_core.app import ConfigError, RequestError, RobotConfig
from ibrobot_core.schema import TransportConfig

from .pair import WAIT_S, free_endpoint, router, wait_for

topic = command_line("topic")

PATIENT = """
from importlib import import_module
import_module("ibrobot_zenoh.commands.network")._CONNECT_S = 30.0
import_module("ibrobot_zenoh.transport").ZenohTransport.shared_topics.__defaults__ = (30.0,)
"""
STATE = JointState(Header(5, "base"), ("pan",), [0.5])


@pytest.fixture
def endpoint() -> str:
    return free_endpoint()


@pytest.fixture
def robot(endpoint: str) -> Iterator[ZenohTransport]:
    """It shares /joint_states again and again, and listens to /lamp."""
    transport = router(endpoint)
    ended = threading.Event()

    def share() -> None:
        while not ended.wait(0.005):
            transport.publish_message("/joint_states", STATE)

    sharing = threading.Thread(target=share)
    sharing.start()
    yield transport
    ended.set()
    sharing.join()
    transport.close()


@pytest.fixture(autouse=True)
def _without_shared_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whose files Zenoh keeps open."""
    from_options = network_module.options_from

    def options(*arguments: Any) -> ZenohOptions:
        return attrs.evolve(from_options(*arguments), shared_memory=False)

    monkeypatch.setattr(network_module, "options_from", options)


@pytest.fixture(autouse=True)
def _patient_commands(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(network_module, "_CONNECT_S", WAIT_S)
    monkeypatch.setattr(ZenohTransport.shared_topics, "__defaults__", (WAIT_S,))
    monkeypatch.setattr("ibrobot_zenoh.commands.topic._HEARD_S", WAIT_S)


def run(*arguments: str) -> str:
    result = CliRunner().invoke(topic, arguments, catch_exceptions=True)
    if result.exception is not None:
        raise result.exception
    return result.output


def test_list(robot: ZenohTransport, endpoint: str):
    wait_for(lambda: robot.shared_topics(WAIT_S))
    assert run("list", "--endpoint", endpoint) == "/joint_states\n"
    message = run("list", "--endpoint", endpoint, "--types").split("  ")
    assert message[:2] == ["/joint_states", "sensor_msgs/msg/JointState"]
    assert run("list", "--endpoint", endpoint, "--domain", "3") == "no topics are shared\n"


def test_echo(robot: ZenohTransport, endpoint: str):
    documents = list(yaml.safe_load_all(run("echo", "/joint_states", "--endpoint", endpoint, "-n", "2")))
    expected = {
        "header": {"stamp_ns": 5, "frame_id": "base"},
        "name": ["pan"],
        "position": [0.5],
        "velocity": [],
        "effort": [],
    }
    assert documents == [expected, expected, None]


def test_hz(robot: ZenohTransport, endpoint: str):
    output = run("hz", "/joint_states", "--endpoint", endpoint, "-n", "1", "--period", "3")
    rate, unit, *_ = output.split()
    assert unit.startswith("Hz")
    assert 1 < float(rate) <= 400  # 200 at most, and more where some had waited for a busy machine
    silent = run("hz", "/silence", "--endpoint", endpoint, "-n", "1", "--period", "0.02")
    message = "/silence has no publisher yet; available: /joint_states\n"
    assert silent == f"{message}fewer than two messages on /silence in 0.02 s\n"


def test_pub(robot: ZenohTransport, endpoint: str):
    arrived: queue.SimpleQueue[Message] = queue.SimpleQueue()
    robot.subscribe_messages("/lamp", arrived.put)
    assert run("pub", "/lamp", "std_msgs/msg/Bool", "{data: true}", "--endpoint", endpoint) == ""
    assert arrived.get(timeout=WAIT_S) == Bool(True)
    run("pub", "/lamp", "std_msgs/msg/Bool", "data: false", "--endpoint", endpoint, "--rate", "500", "-n", "3")
    assert [arrived.get(timeout=WAIT_S) for _ in range(3)] == [Bool(False)] * 3


def test_words_of_ros2(robot: ZenohTransport, endpoint: str):
    arrived: queue.SimpleQueue[Message] = queue.SimpleQueue()
    robot.subscribe_messages("/lamp", arrived.put)
    run("pub", "-1", "-w", "/lamp", "std_msgs/msg/Bool", "{data: true}", "--endpoint", endpoint)
    run("pub", "-r", "500", "-t", "2", "/lamp", "std_msgs/msg/Bool", "{data: false}", "--endpoint", endpoint)
    run("pub", "--times", "1", "/lamp", "std_msgs/msg/Bool", "{data: true}", "--endpoint", endpoint)
    assert [arrived.get(timeout=WAIT_S) for _ in range(4)] == [Bool(each) for each in (True, False, False, True)]
    assert run("list", "-t", "--endpoint", endpoint).startswith("/joint_states  sensor_msgs/msg/JointState")
    echoed = run("echo", "--once", "/joint_states", "--endpoint", endpoint)
    assert len(list(yaml.safe_load_all(echoed))) == 2
    both = ["pub", "--once", "--rate", "1", "/lamp", "std_msgs/msg/Bool", "{}", "--endpoint", endpoint]
    with pytest.raises(RequestError, match="--once excludes --rate and --times"):
        run(*both)


def test_pub_warns_without_a_subscriber(robot: ZenohTransport, endpoint: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("ibrobot_zenoh.commands.topic._HEARD_S", 0.05)
    result = CliRunner().invoke(topic, ["pub", "/dark", "std_msgs/msg/Bool", "data: true", "--endpoint", endpoint])
    assert result.exit_code == 0
    assert result.output == "/dark has no subscriber yet\n"


def test_pub_of_another_type_is_refused(robot: ZenohTransport, endpoint: str):
    wait_for(lambda: robot.shared_topics(WAIT_S))
    with pytest.raises(
        IbrobotError, match="topic /joint_states carries sensor_msgs/msg/JointState, not std_msgs/msg/B"
    ):
        run("pub", "/joint_states", "std_msgs/msg/Bool", "data: true", "--endpoint", endpoint)


@pytest.mark.parametrize("command", [["echo", "/joint_states"], ["hz", "/joint_states", "--period", "0.05"]])
def test_ctrl_c_ends_it_cleanly(command: list[str], robot: ZenohTransport, endpoint: str):
    with subprocess.Popen(
        [*ibrobot_command(PATIENT), "topic", *command, "--endpoint", endpoint],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline()
        process.send_signal(signal.SIGINT)
        _, message = process.communicate(timeout=WAIT_S)
    assert (process.returncode, message) == (0, "")


def test_which_network(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(network_module, "_CONNECT_S", 3.0)  # for as long it tries
    with pytest.raises(RequestError, match="no network: give --config CONFIG, or --endpoint"):
        run("list")
    with pytest.raises(RequestError, match="is not an endpoint"):
        run("list", "--endpoint", "gpu")
    with pytest.raises(RequestError, match="certificates are given by --config"):
        run("list", "--endpoint", "tls/a:1")
    nobody = free_endpoint()
    with pytest.raises(IbrobotError, match=f"{nobody}: nobody listens there: is the robot, server or router up"):
        run("list", "--endpoint", nobody)


@pytest.mark.parametrize(
    ("options", "connect"),
    [
        ({"connect": ("tcp/gpu.lab:7447",), "namespace": "robot1", "domain": 3}, ("tcp/gpu.lab:7447",)),
        ({"mode": "router", "listen": ("tcp/0.0.0.0:1",), "users": Path("u")}, ("tcp/127.0.0.1:1",)),
        ({"mode": "router", "listen": ("tcp/[::]:1",), "trusted_network": True}, ("tcp/[::1]:1",)),
    ],
)
def test_the_network_of_a_config(options: dict[str, Any], connect: tuple[str, ...], monkeypatch: pytest.MonkeyPatch):
    """It is a client there, whatever the robot is."""
    use_config(monkeypatch, TransportConfig("zenoh", ZenohOptions(**options)))
    found = network_module.options_from("robot", (), None)
    assert (found.mode, found.connect, found.listen, found.users) == ("client", connect, (), None)
    assert (found.namespace, found.domain) == ("", options.get("domain", 0))
    assert network_module.options_from("robot", ("tcp/other:1",), 9).connect == ("tcp/other:1",)


@pytest.mark.parametrize("transport", [None, TransportConfig("local", Options())])
def test_a_config_without_network(transport: TransportConfig | None, monkeypatch: pytest.MonkeyPatch):
    use_config(monkeypatch, transport)
    with pytest.raises(NotSupported, match=r"has (no transport|transport local); topics are shared by transport"):
        network_module.options_from("robot", (), None)


def use_config(monkeypatch: pytest.MonkeyPatch, transport: TransportConfig | None) -> None:
    config = RobotConfig(
        robot=Robot("r", ()), executors={}, control_modes={}, default_control_mode="m", transport=transport
    )
    monkeypatch.setattr("ibrobot_core.app.find_config", lambda name, registry: Path(name))
    monkeypatch.setattr("ibrobot_core.app.load_config", lambda path, communicates: config)


def test_messages_from_text():
    assert message_from("sensor_msgs/msg/JointState", "{header: {}, name: [a], position: [1, 2.5]}") == JointState(
        Header(), ("a",), [1.0, 2.5]
    )
    with pytest.raises(NotSupported, match="did you mean 'std_msgs/msg/Bool'"):
        message_from("std_msgs/Bool", "data: true")
    for text, message in (
        ("data: x", "data: expected true or false, got 'x'"),
        ("dat: true", "did you mean 'data'"),
        ("[1", "MESSAGE"),
        ("5", "expected a mapping"),
    ):
        with pytest.raises(ConfigError, match=message):
            message_from("std_msgs/msg/Bool", text)
    with pytest.raises(ConfigError, match="expected a number, got 'a'"):
        message_from("std_msgs/msg/Float64MultiArray", "data: [a]")


def test_messages_as_text():
    long = Float64MultiArray(np.arange(20.0))
    assert yaml.safe_load(shown(long, full=True))["data"] == list(range(20))
    assert yaml.safe_load(shown(long, full=False))["data"] == [*range(16), "… 4 more"]

"""Options: what is refused and why; passwords; access control."""

from __future__ import annotations

import queue
from pathlib import Path
from typing import Any

import pytest
from ibrobot_testing import host_context
from ibrobot_zenoh.options import Share, Tls, ZenohOptions

from ibrobot_core.api import TransportError
from ibrobot_core.app import installed_plugins

from .pair import WAIT_S, client, free_endpoint, make, router, settle, wait_for

TLS = Tls(Path("ca.pem"), Path("certificate.pem"), Path("key.pem"))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "needs endpoints to connect to"),
        ({"connect": ("gpu.lab:7447",)}, "is not an endpoint; use PROTOCOL/HOST:PORT"),
        ({"connect": ("tcp/gpu.lab",)}, "has no port; use PROTOCOL/HOST:PORT, e.g. tcp/gpu.lab:7447"),
        ({"connect": ("tcp/a:1",), "listen": ("tcp/127.0.0.1:1",)}, "a client does not listen"),
        ({"connect": ("tls/a:1",)}, "tls/a:1 needs tls"),
        ({"connect": ("tcp/a:1",), "tls": TLS}, "tcp/a:1 would not use tls; write tls/a:1"),
        ({"connect": ("tcp/a:1",), "user": "me"}, "set both user and password"),
        (
            {"connect": ("tcp/a:1",), "user": "me", "password": "x", "share": Share(actions=("arm",))},
            "share.actions: a server that knows robots by name lets none of them take goals",
        ),
        ({"mode": "router", "listen": ("tcp/0.0.0.0:1",)}, "can be reached by other machines: set tls or users, or"),
        ({"mode": "router", "listen": ("tcp/[::]:1",)}, "can be reached by other machines"),
        ({"mode": "peer", "listen": ("tcp/gpu.lab:1",)}, "can be reached by other machines"),
        ({"connect": ("tcp/a:1",), "namespace": "a b"}, "is not a ROS 2 name"),
        ({"connect": ("tcp/a:1",), "user": "a/b", "password": "x"}, "'a/b' cannot be a robot's name"),
    ],
)
def test_refused(options: dict[str, Any], message: str):
    with pytest.raises(ValueError, match=message):
        ZenohOptions(**options)


@pytest.mark.parametrize(
    "options",
    [
        {"mode": "router", "listen": ("tcp/127.0.0.1:1", "tcp/[::1]:1", "tcp/localhost:1", "unixsock-stream/a.sock")},
        {"mode": "router", "listen": ("tcp/0.0.0.0:1",), "trusted_network": True},
        {"mode": "router", "listen": ("tcp/0.0.0.0:1",), "users": Path("users.txt")},
        {"mode": "router", "listen": ("tls/0.0.0.0:1",), "tls": TLS},
        {"mode": "peer", "connect": ("tcp/gpu.lab:7447#iface=eth0",)},
    ],
)
def test_accepted(options: dict[str, Any]):
    ZenohOptions(**options)


def test_the_yaml_s_type():
    endpoint = free_endpoint()
    descriptor = installed_plugins().find("transport", "zenoh")
    transport = descriptor.make(ZenohOptions(listen=(endpoint,), mode="peer", shared_memory=False), host_context())
    transport.close()


@pytest.mark.parametrize(
    "options", [{"tls": TLS, "listen": ("tls/127.0.0.1:1",)}, {"users": Path("none.txt")}, {"settings": Path("none")}]
)
def test_files_that_are_not_there(options: dict[str, Any]):
    with pytest.raises(TransportError, match=r"ca\.pem: cannot be read|none"):
        make(mode="router", **options)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "users.txt: is empty, must have a line NAME:PASSWORD"),
        ("robot1:a\nrobot2\n", "users.txt:2: is not NAME:PASSWORD"),
        (":a\n", "users.txt:1: is not NAME:PASSWORD"),
        ("robot1:\n", "users.txt:1: is not NAME:PASSWORD"),
        ("robot1:a\nrobot1:b\n", "users.txt:2: 'robot1' is listed twice"),
        ("robot-1:a\n", "users.txt:1: 'robot-1' cannot be a robot's name"),
    ],
)
def test_a_file_of_users_that_says_something_else(text: str, said: str, tmp_path: Path):
    """An empty one would let everybody in."""
    (tmp_path / "users.txt").write_text(text)
    with pytest.raises(TransportError, match=said):
        router(free_endpoint(), users=tmp_path / "users.txt")


@pytest.mark.usefixtures("brief_trials")
def test_passwords(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    users = tmp_path / "users.txt"
    users.write_text("robot1:secret\n")
    endpoint = free_endpoint()
    server = router(endpoint, users=users)
    server.serve("echo", lambda payload, _: payload)
    known = client(endpoint, user="robot1", password="secret")
    settle(known, server, "robot1")
    assert known.request("echo", b"x", WAIT_S) == b"x"
    for wrong in ({"user": "robot1", "password": "guess"}, {}):
        caplog.clear()
        stranger = client(endpoint, **wrong)
        wait_for(lambda: "not connected" in caplog.text)
        with pytest.raises(TransportError, match=r"not connected: .*are user and password right"):
            stranger.request("echo", b"x", WAIT_S)
        stranger.close()
    known.close()
    server.close()


def test_users_are_distinguished_by_their_passwords(tmp_path: Path):
    """The list is made from the file of users: each asks and publishes under its own name, and serves nothing."""
    users = tmp_path / "users.txt"
    users.write_text("robot1:a\nrobot2:b\n")
    endpoint = free_endpoint()
    server = router(endpoint, users=users)
    server.serve("who", lambda payload, sender: f"{sender}".encode())
    arrived: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    server.subscribe("robot1/state", lambda payload: arrived.put(bytes(payload)))
    server.subscribe("robot2/state", lambda payload: arrived.put(bytes(payload)))
    robots = {name: client(endpoint, user=name, password=word) for name, word in (("robot1", "a"), ("robot2", "b"))}
    for name, robot in robots.items():
        settle(robot, server, name)
    robots["robot2"].serve("who", lambda payload, sender: b"a lie")
    settle(server, robots["robot2"], "robot2")
    assert [robots["robot1"].request("who", b"", WAIT_S) for _ in range(5)] == [b"robot1"] * 5
    for name, robot in robots.items():
        with pytest.raises(TransportError, match="may publish only below"):
            robot.publish("state", b"")
        robot.publish(f"{name}/state", name.encode())
        assert arrived.get(timeout=WAIT_S) == name.encode()
    for end in (*robots.values(), server):
        end.close()

"""Attacks of a robot with a valid certificate or password: none of them gets further than its own name."""

from __future__ import annotations

import json
import queue
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import yaml
import zenoh
import zenoh.ext
from click.testing import CliRunner
from ibrobot_ros2 import encode
from ibrobot_testing.command import command_line
from ibrobot_zenoh.options import ZenohOptions
from ibrobot_zenoh.ros2 import Node, typed
from ibrobot_zenoh.transport import ZenohTransport

from ibrobot_core.api import Int32, Payload
from ibrobot_core.api import Message as RosMessage
from ibrobot_core.app import single_options

from .pair import WAIT_S, free_endpoint, keep

certs = command_line("certs")

REQUESTS = 20
CLAIMED = [
    "**",
    "*/**",
    "ibrobot/**",
    "ibrobot/service/**",
    "ibrobot/service/infer/net",
    "ibrobot/service/*/infer/net",
    "ibrobot/service/robot1/infer/net",
    "ibrobot/service/robot2/infer/net",
]
"""What the attacker declares that it answers."""


class Lab:
    """A server and two robots, each with the transport options that `ibrobot certs` printed for it."""

    def __init__(self, folder: Path) -> None:
        arguments = [str(folder), "--server", "localhost,127.0.0.1", "--robot", "robot1", "--robot", "robot2"]
        result = CliRunner().invoke(certs, arguments)
        assert result.exit_code == 0, result.output
        self.folder = folder
        self.endpoint = free_endpoint("tls")
        self._sections = {
            part.partition(":")[0]: yaml.safe_load(part.partition("\n")[2])["transport"]
            for part in result.output.split("\n# ")[1:]
        }

    def options(self, name: str) -> ZenohOptions:
        section = {key: value for key, value in self._sections[name].items() if key != "type"}
        section["tls"] = {key: str(self.folder / file) for key, file in section["tls"].items()}
        section["listen" if "listen" in section else "connect"] = [self.endpoint]
        section["shared_memory"] = False
        return single_options(ZenohOptions, [f"{key}={json.dumps(value)}" for key, value in section.items()], name)

    def open(self, name: str) -> ZenohTransport:
        return keep(self.options(name))

    @contextmanager
    def attacker(self, name: str) -> Iterator[zenoh.Session]:
        """Zenoh itself, with a robot's certificate: what it says is up to the attacker."""
        config = zenoh.Config()
        folder = self.folder / name
        for key, value in {
            "mode": "client",
            "connect/endpoints": [self.endpoint],
            "connect/timeout_ms": int(1000 * WAIT_S),
            "scouting/multicast/enabled": False,
            "transport/shared_memory/enabled": False,
            "timestamping/enabled": True,
            "transport/link/tls": {
                "root_ca_certificate": str(folder / "ca.pem"),
                "enable_mtls": True,
                "connect_certificate": str(folder / "certificate.pem"),
                "connect_private_key": str(folder / "key.pem"),
            },
        }.items():
            config.insert_json5(key, json.dumps(value))
        with zenoh.open(config) as session:
            yield session


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Lab:
    return Lab(tmp_path_factory.mktemp("lab") / "certificates")


def settled(session: zenoh.Session) -> None:
    """Wait until the server has taken in all that `session` said before: it answers in order."""
    for _ in session.liveliness().get("ibrobot/served/**", timeout=WAIT_S):
        pass


def test_another_robot_cannot_act_as_the_model(lab: Lab):
    server, robot = lab.open("localhost"), lab.open("robot1")
    stolen: queue.SimpleQueue[bytes] = queue.SimpleQueue()

    def steal(query: zenoh.Query) -> None:
        with query:
            stolen.put(query.payload.to_bytes() if query.payload is not None else b"")
            query.reply(query.key_expr, b"the attacker's actions")

    with lab.attacker("robot2") as attacker:
        for key in CLAIMED:
            attacker.declare_queryable(key, steal, complete=True)
        attacker.liveliness().declare_token("ibrobot/served/infer/net/attacker")
        settled(attacker)
        with lab.attacker("robot1") as other:  # the attacker's token is not passed on
            seen: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
            other.liveliness().declare_subscriber("ibrobot/served/**", seen.put, history=True)
            settled(other)
            assert seen.empty()
        present: queue.SimpleQueue[bool] = queue.SimpleQueue()
        robot.watch("infer/net", present.put)
        assert present.get() is False
        server.serve("infer/net", lambda payload, sender: payload)
        while not present.get(timeout=WAIT_S):
            pass
        answers = [bytes(robot.request("infer/net", str(i).encode(), WAIT_S)) for i in range(REQUESTS)]
        assert answers == [str(i).encode() for i in range(REQUESTS)]
        assert stolen.empty()


def test_a_request_is_its_sender_s_whatever_it_claims(lab: Lab):
    """A server tells robots apart by their certificates: a request of robot2 in robot1's name is robot2's."""
    server, robot = lab.open("localhost"), lab.open("robot1")
    senders: list[str | None] = []

    def answer(payload: Payload, sender: str | None) -> Payload:
        senders.append(sender)
        return payload

    server.serve("infer/net", answer)
    frame = b"a request of robot1"
    assert bytes(robot.request("infer/net", frame, WAIT_S)) == frame
    with lab.attacker("robot2") as attacker:
        for key in ("robot1", "*", "localhost", "anybody", "**"):
            replies = attacker.get(f"ibrobot/service/{key}/infer/net", payload=frame, timeout=WAIT_S)
            assert not [reply for reply in replies if reply.ok is not None], key
        answered = list(attacker.get("ibrobot/service/robot2/infer/net", payload=frame, timeout=WAIT_S))
        assert len(answered) == 1
        assert answered[0].ok is not None
    assert senders == ["robot1", "robot2"]


def test_nobody_publishes_under_another_s_name(lab: Lab):
    """Neither values, nor what latched topics keep, nor that there is a topic."""
    server, robot = lab.open("localhost"), lab.open("robot1")
    arrived: queue.SimpleQueue[RosMessage] = queue.SimpleQueue()
    for topic in ("/robot1/count", "/robot10/count", "/count", "/robot2/count"):
        server.subscribe_messages(topic, arrived.put)
    raw: queue.SimpleQueue[Payload] = queue.SimpleQueue()
    server.subscribe("robot1/state", raw.put)
    kind = typed("std_msgs/msg/Int32", hashed=True)
    node = Node(0, "abc", "robot1")
    with lab.attacker("robot2") as attacker:
        lie = bytes(encode(Int32(-1)))
        for topic in ("robot1/count", "robot10/count", "count"):
            attacker.put(f"0/{topic}/{kind}", lie, congestion_control=zenoh.CongestionControl.BLOCK)
            attacker.delete(f"0/{topic}/{kind}")
            token = node.publisher_token(1, f"/{topic}", "std_msgs/msg/Int32", hashed=True, latched=False)
            attacker.liveliness().declare_token(token)
            cache = zenoh.ext.CacheConfig(max_samples=1)
            latched = zenoh.ext.declare_advanced_publisher(
                attacker, f"0/{topic}/{kind}", cache=cache, publisher_detection=True
            )
            latched.put(lie)
        attacker.put("ibrobot/topic/robot1/state", b"lie", congestion_control=zenoh.CongestionControl.BLOCK)
        own = f"0/robot2/count/{kind}"
        attacker.put(own, bytes(encode(Int32(2))), congestion_control=zenoh.CongestionControl.BLOCK)
        assert arrived.get(timeout=WAIT_S) == Int32(2)
        server.subscribe_messages("/robot1/count", arrived.put)  # one that comes late asks for what is kept
        robot.publish_message("/count", Int32(1))
        assert arrived.get(timeout=WAIT_S) == arrived.get(timeout=WAIT_S) == Int32(1)
        assert arrived.empty()
        assert raw.empty()
        assert [topic.name for topic in robot.shared_topics(WAIT_S)] == ["/robot1/count"]

"""Attacks on `ibrobot serve --protocol openpi` and `gr00t`, while another client asks for chunks.

    python benchmarks/policy_attack.py [--seconds 3] [--frames 1000]

Each attack lasts for some seconds: damaged frames, frames that announce 1 GB, 200 connections that send a byte each
second, an HTTP client and noise, clients that ask and never read, and a wrong key in a loop. Beside it an honest
client asks 20 times a second. Prints its answers and its errors, the median and the longest time of a request beside
those without an attack, and the largest memory of the server. Exits with 1 if the honest client got an error or a
wrong answer, or if the server took 300 MB more than at rest.
"""

from __future__ import annotations

import argparse
import json
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import zmq
from ibrobot_policy_wire import pack, pack_npy, unpack, unpack_npy
from websockets.sync.client import connect

LIMIT_KB = 300_000
PERIOD_S = 0.05
SIZE, HORIZON = 6, 10
STATE = "observation.state"
KEY = "pa55word"
SERVER = """
import logging, sys
from ibrobot_serve.client_model import ClientModel
from ibrobot_serve.{module} import {name}
from ibrobot_testing import host_context
from ibrobot_testing.fakes import FakePolicy
logging.disable(logging.CRITICAL)
policy = FakePolicy(host_context())
policy.load()
server = {name}(ClientModel(policy, "net", "openpi"), "127.0.0.1", 0, "pa55word")
print(server.port, flush=True)
sys.stdin.read()
server.close()
"""
SERVERS = {"openpi": ("openpi_server", "OpenpiServer"), "gr00t": ("gr00t_server", "Gr00tServer")}
ZMTP = b"\xff" + bytes(8) + b"\x7f\x03\x00NULL" + bytes(48)
READY = b"\x05READY\x0bSocket-Type\x00\x00\x00\x03REQ"
HELLO = (
    b"GET / HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nAuthorization: Api-Key pa55word\r\n\r\n"
)


@contextmanager
def served(protocol: str) -> Iterator[tuple[int, int]]:
    """A server in another process: its port and process id."""
    module, name = SERVERS[protocol]
    code = SERVER.format(module=module, name=name)
    process = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        yield int(process.stdout.readline()), process.pid
    finally:
        process.kill()
        process.communicate()


def memory_kb(pid: int, field: str = "VmHWM") -> int:
    """Memory of a process [kB]: the largest, or `VmRSS` for the present."""
    status = Path(f"/proc/{pid}/status").read_text(encoding="utf-8")
    return int(next(line for line in status.splitlines() if line.startswith(field)).split()[1])


class Client:
    """Asks one server, by its protocol."""

    def __init__(self, protocol: str, port: int, key: str = KEY) -> None:
        self._key = key
        if protocol == "openpi":
            self._web = connect(f"ws://127.0.0.1:{port}", additional_headers={"Authorization": f"Api-Key {key}"})
            self._web.recv()
            self._context = None
        else:
            self._context = zmq.Context()
            self._zmq = self._context.socket(zmq.REQ)
            self._zmq.setsockopt(zmq.LINGER, 0)
            self._zmq.setsockopt(zmq.RCVTIMEO, 10_000)
            self._zmq.connect(f"tcp://127.0.0.1:{port}")

    def close(self) -> None:
        """Disconnect."""
        if self._context is None:
            self._web.close()
        else:
            self._zmq.close()
            self._context.term()

    def sent(self, content: bytes) -> Any:
        """The answer to a message."""
        if self._context is None:
            self._web.send(content)
            answer = self._web.recv(10.0)
            return unpack(answer) if isinstance(answer, bytes) else answer
        self._zmq.send(content)
        return unpack_npy(self._zmq.recv())

    def request(self, state: Any) -> bytes:
        """A request for a chunk."""
        if self._context is None:
            return pack({STATE: state})
        observation = {"state": {"state": state[None, None]}}
        return pack_npy({"endpoint": "get_action", "data": {"observation": observation}, "api_token": self._key})

    def chunk(self, state: Any) -> Any:
        """The actions for a state."""
        answer = self.sent(self.request(state))
        return answer["actions"] if self._context is None else answer[0]["action"][0]


def damaged(protocol: str, port: int, stop: threading.Event, frames: int) -> int:
    """Messages with flipped and cut bytes."""
    random = np.random.default_rng(0)
    with closing(Client(protocol, port)) as client:
        good, sent = client.request(np.zeros(SIZE, np.float32)), 0
        while not stop.is_set() or sent < frames:
            content = bytearray(good)
            for place in random.integers(0, len(good), random.integers(1, 6)):
                content[place] = random.integers(256)
            client.sent(bytes(content[: random.integers(1, len(good) + 1)]))
            sent += 1
    return sent


def bare(port: int, *contents: bytes) -> socket.socket:
    """A connection that has sent something."""
    connection = socket.create_connection(("127.0.0.1", port), 5.0)
    for content in contents:
        connection.sendall(content)
    return connection


def gigabytes(protocol: str, port: int, stop: threading.Event, frames: int) -> int:
    """Frames that announce 1 GB, then some of it."""
    sent = 0
    while not stop.is_set():
        with suppress(OSError):
            if protocol == "openpi":
                connection = bare(port, HELLO)
                connection.recv(4096)
                connection.sendall(b"\x82\xff" + struct.pack(">Q", 1 << 30) + bytes(4))
            else:
                connection = bare(
                    port, ZMTP, b"\x04" + bytes([len(READY)]) + READY, b"\x02" + struct.pack(">Q", 1 << 30)
                )
            with closing(connection):
                for _ in range(16):
                    connection.sendall(bytes(1 << 20))
        sent += 1
    return sent


def slow(protocol: str, port: int, stop: threading.Event, frames: int) -> int:
    """Connections that send a byte each second."""
    begin, connections = HELLO if protocol == "openpi" else ZMTP, []
    for _ in range(200):
        with suppress(OSError):
            connections.append(bare(port))
    for content in begin:
        for connection in connections:
            with suppress(OSError):
                connection.sendall(bytes([content]))
        if stop.wait(1.0):
            break
    for connection in connections:
        connection.close()
    return len(connections)


def others(protocol: str, port: int, stop: threading.Event, frames: int) -> int:
    """Clients of other protocols, and noise."""
    random, sent = np.random.default_rng(0), 0
    http = b"POST /v1/chat HTTP/1.1\r\nHost: x\r\nContent-Length: 9999999\r\n\r\n{}"
    while not stop.is_set():
        for content in (http, ZMTP, HELLO, b"\x16\x03\x01\x02\x00\x01\x00", random.bytes(2000)):
            with suppress(OSError), closing(bare(port, content)) as connection:
                connection.settimeout(0.01)
                connection.recv(4096)
            sent += 1
    return sent


def deaf(protocol: str, port: int, stop: threading.Event, frames: int) -> int:
    """Clients that ask and never read; GR00T's protocol answers one request of a client at a time."""
    clients, sent = [Client(protocol, port) for _ in range(10)], 0
    request = clients[0].request(np.zeros(SIZE, np.float32))
    while not stop.is_set():
        for client in clients:
            if client._context is None:
                client._web.socket.setblocking(False)
                with suppress(Exception):
                    client._web.send(request)
            else:
                with suppress(zmq.ZMQError):
                    client._zmq.send(request, zmq.NOBLOCK)
            sent += 1
        time.sleep(0.001)
    for client in clients:
        if client._context is None:
            client._web.socket.close()
        else:
            client.close()
    return sent


def strangers(protocol: str, port: int, stop: threading.Event, frames: int) -> int:
    """Clients with a wrong key."""
    sent = 0
    while not stop.is_set():
        with suppress(Exception), closing(Client(protocol, port, "password")) as client:
            client.chunk(np.zeros(SIZE, np.float32))
        sent += 1
    return sent


ATTACKS: Mapping[str, Callable[[str, int, threading.Event, int], int] | None] = {
    "none": None,
    "damaged": damaged,
    "1 GB": gigabytes,
    "slow": slow,
    "others": others,
    "deaf": deaf,
    "strangers": strangers,
}


def asked(protocol: str, port: int, stop: threading.Event) -> dict[str, Any]:
    """What an honest client meets until `stop`."""
    rng, times_ms, errors, wrong = np.random.default_rng(1), [], 0, 0
    client = Client(protocol, port)
    reference = client.chunk(np.zeros(SIZE, np.float32))
    while not stop.wait(PERIOD_S):
        state = rng.uniform(-0.5, 0.5, SIZE).astype(np.float32)
        begun_s = time.perf_counter()
        try:
            found = client.chunk(state)
        except Exception:  # noqa: BLE001 - counted
            errors += 1
            continue
        times_ms.append((time.perf_counter() - begun_s) * 1e3)
        # The fake moves linearly from the state to its goal.
        wrong += (
            found.shape != (HORIZON, SIZE) or not np.isfinite(found).all() or bool(np.array_equal(found, reference))
        )
    with suppress(Exception):
        client.close()
    return {
        "answers": len(times_ms),
        "errors": errors,
        "wrong": wrong,
        "p50_ms": round(float(np.median(times_ms)), 2),
        "longest_ms": round(max(times_ms), 1),
    }


def main() -> int:
    """Every attack on both servers; 1 if one succeeds."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seconds", type=float, default=3.0)
    parser.add_argument("--frames", type=int, default=1000, help="damaged frames at least")
    given = parser.parse_args()
    failed = False
    for protocol in SERVERS:
        with served(protocol) as (port, pid):
            rest_kb = memory_kb(pid)
            for name, attack in ATTACKS.items():
                stop, count = threading.Event(), [0]

                def run(
                    attack: Any = attack,
                    stop: threading.Event = stop,
                    count: list[int] = count,
                    port: int = port,
                    protocol: str = protocol,
                ) -> None:
                    if attack is not None:
                        count[0] = attack(protocol, port, stop, given.frames)

                attacker = threading.Thread(target=run)
                ender = threading.Timer(given.seconds, stop.set)
                attacker.start()
                ender.start()
                result = asked(protocol, port, stop)
                attacker.join()
                more_kb = memory_kb(pid) - rest_kb
                print(json.dumps({
                    "server": protocol, "attack": name, "sent": count[0], **result, "more_mb": round(more_kb / 1000),
                }), flush=True)  # fmt: skip
                failed |= bool(result["errors"] or result["wrong"]) or more_kb > LIMIT_KB
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())

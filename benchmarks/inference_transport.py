"""From a request to its chunk with a policy that does nothing: each way to a model, and LeRobot's own, in one run.

    python benchmarks/inference_transport.py [--count 200] [--pause 0] [--lerobot PYTHON]

Every way carries the same observations: two raw pictures of 640x480, two of 224x224 in float32, two JPEGs of 38 kB,
each with six joint positions; a chunk of 50x6 comes back. `tcp` sends a frame of the same bytes over a plain socket
between two processes and gets a chunk's back: the floor. `tls` is the same with TLS and certificates of both sides, the
floor of mTLS. `process` is execution mode process; `zenoh` and `zenoh mTLS` are execution mode distributed as between
machines, `zenoh shm` as within one. `lerobot` is its RobotClient and PolicyServer, in the interpreter PYTHON, which has
`lerobot[async]==0.6.1`: it has no JPEG there and sends raw pictures of as many bytes.

All ways are measured in turn, eight times, since a machine may be slower for a while; LeRobot, which is slow to
start, every other time. Times are in ms: request to chunk p50 and p99, how long the control loop is blocked in
asking, and processor time of both sides together for a request. One request follows the other; with a pause between
them [s], all ways find their memory and code out of the caches.
Exits with 1 where ours is less than 5 times as fast as LeRobot when given, raw cameras over Zenoh take more than 5
times their floor, `process` more than 3 times, or asking blocks for over 1 ms.
"""

from __future__ import annotations

import argparse
import json
import logging
import math
import socket
import ssl
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from apparatus import cpu_s, ibrobot, in_rounds, plugin, report, started, transport
from ibrobot_serve.process import ProcessEngine
from ibrobot_serve.remote import RemoteEngine
from ibrobot_serve.service import InferenceService
from ibrobot_serve.wire import WireKind, WireMessage, encode
from ibrobot_testing import host_context
from ibrobot_testing.ports import free_port

from ibrobot_core.config import load_config
from ibrobot_core.inference.client import DispatchInfer, EngineClient
from ibrobot_core.interfaces import Engine, Frame
from ibrobot_core.plugins import installed_plugins

PLUGIN = '''
import numpy as np
from ibrobot_core import hookimpl
from ibrobot_core.descriptors import HardwareDescriptor, PolicyDescriptor
from ibrobot_testing.fakes import FakeHardware, FakePolicy

class Null(FakePolicy):
    """Hands on what it is given and answers with zeros."""
    chunk = np.zeros((50, 6), np.float32)
    def preprocess(self, frame):
        return frame.values
    def infer(self, tensors):
        return {"actions": self.chunk}
    def postprocess(self, tensors):
        return tensors["actions"].astype(np.float64)

@hookimpl
def ibrobot_hardware():
    yield HardwareDescriptor("still", lambda options, ctx: FakeHardware(ctx), "an arm", simulated=True)

@hookimpl
def ibrobot_policies():
    yield PolicyDescriptor("null", lambda options, ctx: Null(ctx), "does nothing")
'''
ROBOT = """
robot:
  name: mini
  joints: [{name: pan, lower: -1.0, upper: 1.0, max_velocity: 3.0, max_acceleration: 40.0}]
  groups: {arm: [pan]}
simulation: {type: still}
executors: {arm_position: {type: position, group: arm}}
models: {null: {type: "null"}}
control_modes: {idle: {executors: [arm_position]}}
default_control_mode: idle
"""
CHANCE = np.random.default_rng(0)
STATE = np.full(6, 0.5, np.float32)
PAYLOADS = {
    "2x640x480 uint8": CHANCE.integers(0, 255, (2, 480, 640, 3), dtype=np.uint8),
    "2x224x224 float32": CHANCE.random((2, 3, 224, 224), dtype=np.float32),
    "2 JPEGs": CHANCE.integers(0, 255, (2, 38_400), dtype=np.uint8),
}
WARM_UP = 20
ROUNDS = 8
LEROBOT_RATIO, BLOCKED_MS = 5.0, 1.0
LIMITS = {"process": ("tcp", 3.0), "zenoh": ("tcp", 5.0), "zenoh shm": ("tcp", 5.0), "zenoh mTLS": ("tls", 5.0)}
"""How often a floor's time raw cameras may take."""


def measure(ask: Callable[[int], float], other: int, count: int, pause_s: float) -> dict[str, Any]:
    """Ask again and again; `ask` returns how long it was blocked [s], and `other` is the process that answers."""
    latencies, blocked = [], []
    for number in range(1, count + WARM_UP + 1):
        if number == WARM_UP + 1:
            begun_s = cpu_s("self") + cpu_s(other)
        time.sleep(pause_s)
        asked_s = time.perf_counter()
        blocked.append(ask(number) * 1e3)
        latencies.append((time.perf_counter() - asked_s) * 1e3)
    used_s = cpu_s("self") + cpu_s(other) - begun_s
    return {"latencies": latencies[WARM_UP:], "blocked": blocked[WARM_UP:], "cpu_ms": used_s / count * 1e3}


def asking(client: EngineClient, pictures: np.ndarray) -> Callable[[int], float]:
    """As the dispatcher asks: submit, and wait for the chunk."""
    values = {
        "observation.state": STATE,
        "observation.images.top": pictures[0],
        "observation.images.wrist": pictures[1],
    }

    def ask(number: int) -> float:
        frame = Frame(time.time_ns(), values)
        begun_s = time.perf_counter()
        client.submit(DispatchInfer(number, frame))
        blocked_s = time.perf_counter() - begun_s
        chunk = client.poll(10.0)
        if chunk is None or chunk.actions is None or chunk.id != number:
            raise SystemExit(f"no chunk: {chunk}")
        return blocked_s

    return ask


def security_options(certificates: Path | None) -> tuple[str, ...]:
    """The arguments that tell a process of its certificates."""
    return ("--certificates", str(certificates)) if certificates else ()


def receive(connection: socket.socket, buffer: memoryview) -> int:
    """A payload with its size before it; returns the size, 0 at the end."""
    head = bytearray(8)
    got = 0
    while got < 8:
        got += (n := connection.recv_into(memoryview(head)[got:]))
        if not n:
            return 0
    size: int = struct.unpack("<Q", head)[0]
    got = 0
    while got < size:
        got += connection.recv_into(buffer[got:size])
    return size


def secured(connection: socket.socket, certificates: Path | None, machine: str) -> socket.socket:
    """The same connection, encrypted where there are certificates."""
    if certificates is None:
        return connection
    server, place = machine == "localhost", certificates / machine
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER if server else ssl.PROTOCOL_TLS_CLIENT)
    context.verify_mode = ssl.CERT_REQUIRED
    context.load_verify_locations(place / "ca.pem")
    context.load_cert_chain(place / "certificate.pem", place / "key.pem")
    return context.wrap_socket(connection, server, server_hostname=None if server else "localhost")


def echo(port: int, certificates: Path | None) -> None:
    """The other end of the floor: takes a payload, answers with a chunk's bytes."""
    buffer, answer = memoryview(bytearray(1 << 24)), bytes(1280)
    with socket.create_server(("127.0.0.1", port)) as listening:
        print("ready", flush=True)
        connection, _ = listening.accept()
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection = secured(connection, certificates, "localhost")
        while receive(connection, buffer):
            connection.sendall(struct.pack("<Q", len(answer)) + answer)


def floor(pictures: np.ndarray, count: int, pause_s: float, certificates: Path | None = None) -> dict[str, Any]:
    """A plain socket, or one with TLS."""
    tensors = {"state": STATE, "top": pictures[0], "wrist": pictures[1]}
    frame = bytes(encode(WireMessage(WireKind.REQUEST, 1, tensors)))
    buffer = memoryview(bytearray(1 << 20))
    port = free_port()
    with started(__file__, "--echo", port, *security_options(certificates)) as (process, _):
        plain = socket.create_connection(("127.0.0.1", port))
        plain.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        with secured(plain, certificates, "robot") as connection:

            def ask(number: int) -> float:
                connection.sendall(struct.pack("<Q", len(frame)))
                connection.sendall(frame)
                receive(connection, buffer)
                return 0.0

            return measure(ask, process.pid, count, pause_s)


def tls(folder: Path | None, machine: str) -> dict[str, Any]:
    """The options of a machine's certificates."""
    if folder is None:
        return {}
    from ibrobot_zenoh.options import Tls

    place = folder / machine
    robots = place / "robots.txt"
    listed = robots if robots.exists() else None
    return {"tls": Tls(place / "ca.pem", place / "certificate.pem", place / "key.pem", listed)}


def serve(endpoint: str, certificates: Path | None) -> None:
    """The server, until its standard input ends."""
    null = installed_plugins().find("policy", "null").make(None, host_context())
    network = transport(mode="router", listen=(endpoint,), **tls(certificates, "localhost"))
    service = InferenceService(null, network, "null")
    service.start()
    print("ready", flush=True)
    sys.stdin.read()
    service.close()
    network.close()


def through(
    engine: Engine, other: Callable[[], int], pictures: np.ndarray, count: int, pause_s: float
) -> dict[str, Any]:
    """The client of the host over an engine that is ready."""
    with ExitStack() as stack:
        stack.callback(engine.close)
        engine.start()
        client = EngineClient(installed_plugins().find("policy", "null").make(None, host_context()), engine)
        stack.callback(client.close)
        return measure(asking(client, pictures), other(), count, pause_s)


def over_zenoh(
    pictures: np.ndarray, count: int, pause_s: float, certificates: Path | None = None, *, shared: bool = False
) -> dict[str, Any]:
    """Execution mode distributed."""
    endpoint = f"{'tls/localhost' if certificates else 'tcp/127.0.0.1'}:{free_port()}"
    with started(__file__, "--serve", endpoint, *security_options(certificates)) as (process, _):
        network = transport(connect=(endpoint,), shared_memory=shared, **tls(certificates, "robot"))
        try:
            null = installed_plugins().find("policy", "null").make(None, host_context())
            return through(RemoteEngine(null, network, "null", "robot"), lambda: process.pid, pictures, count, pause_s)
        finally:
            network.close()


def in_process(pictures: np.ndarray, count: int, pause_s: float, folder: Path) -> dict[str, Any]:
    """Execution mode process."""
    (folder / "mini.yaml").write_text(ROBOT)
    config = load_config(folder / "mini.yaml", sim=True)
    fingerprint = installed_plugins().find("policy", "null").make(None, host_context(robot=config.robot)).fingerprint()
    engine = ProcessEngine(config, "null", fingerprint)
    return through(engine, lambda: engine.pid or 0, pictures, count, pause_s)


def summary(payload: str, way: str, rounds: list[dict[str, Any]]) -> dict[str, Any]:
    """One row of the table."""
    p50, p99 = np.percentile(np.concatenate([each["latencies"] for each in rounds]), [50, 99])
    blocked = np.percentile(np.concatenate([each["blocked"] for each in rounds]), 50)
    row = {"payload": payload, "way": way, "p50_ms": float(p50), "p99_ms": float(p99), "blocked_ms": float(blocked)}
    return {**row, "cpu_ms": float(np.mean([each["cpu_ms"] for each in rounds]))}


def measured(
    given: argparse.Namespace, number: int, folder: Path, certificates: Path
) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """A round of every way: payload, way, and what came of it."""
    count = -(-given.count // ROUNDS)
    for payload, pictures in PAYLOADS.items():
        how = (pictures, count, given.pause)
        yield payload, "tcp", floor(*how)
        yield payload, "tls", floor(*how, certificates)
        yield payload, "process", in_process(*how, folder)
        yield payload, "zenoh", over_zenoh(*how)
        yield payload, "zenoh shm", over_zenoh(*how, shared=True)
        yield payload, "zenoh mTLS", over_zenoh(*how, certificates)
    if given.lerobot and number % 2 == 0:
        command = [given.lerobot, Path(__file__).absolute().with_name("lerobot_async.py")]
        command += ["--count", str(count), "--pause", str(given.pause)]
        # LeRobot's logger makes a folder where it runs.
        lines = subprocess.run(command, check=True, capture_output=True, text=True, cwd=folder).stdout.splitlines()
        for row in (json.loads(line) for line in lines if line.startswith('{"payload"')):
            yield row["payload"], row["way"], row


def run(given: argparse.Namespace, folder: Path) -> int:
    """Print the table; 1 when a limit is missed."""
    certificates = folder / "certificates"
    ibrobot("certs", certificates, "--server", "localhost", "--robot", "robot")
    found: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for number in in_rounds(ROUNDS):
        for payload, way, row in measured(given, number, folder, certificates):
            found.setdefault((payload, way), []).append(row)
    rows = [summary(payload, way, rounds) for (payload, way), rounds in found.items()]
    print(
        f"{'':18} {'':11} {'p50':>8} {'p99':>8} {'blocked':>8} {'CPU':>8} {'x tcp':>7}"
        + (f" {'LeRobot':>8}" if given.lerobot else "")
    )
    missed: list[str] = []
    figures: dict[str, float] = {}
    for payload in PAYLOADS:
        mine = {row["way"]: row for row in rows if row["payload"] == payload}
        for way, row in mine.items():
            ratio = row["p50_ms"] / mine["tcp"]["p50_ms"]
            numbers = " ".join(f"{row[key]:8.2f}" for key in ("p50_ms", "p99_ms", "blocked_ms", "cpu_ms"))
            faster = mine["lerobot"]["p50_ms"] / row["p50_ms"] if "lerobot" in mine else math.inf
            print(f"{payload:18} {way:11} {numbers} {ratio:7.1f}" + (f" {faster:7.1f}x" if "lerobot" in mine else ""))
            if way in LIMITS and "uint8" in payload:
                floor_way, limit = LIMITS[way]
                ratio = row["p50_ms"] / mine[floor_way]["p50_ms"]
                figures[f"{way.replace(' ', '_')}_ratio"] = ratio
                if ratio > limit:
                    missed.append(f"{payload} {way}: {ratio:.1f} times {floor_way}, more than {limit:g}")
            if way in ("process", "zenoh", "zenoh shm", "zenoh mTLS"):
                if row["blocked_ms"] > BLOCKED_MS:
                    missed.append(f"{payload} {way}: asking blocks for {row['blocked_ms']:.2f} ms")
                if given.lerobot:
                    figures["least_times_lerobot"] = min(figures.get("least_times_lerobot", math.inf), faster)
                if faster < LEROBOT_RATIO:
                    missed.append(f"{payload} {way}: only {faster:.1f} times as fast as LeRobot")
    print("\n".join(missed) or "all within the limits")
    report(**figures)
    return int(bool(missed))


def main() -> int:
    """With a made-up plugin, so that both sides find the same policy."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--pause", type=float, default=0.0)
    parser.add_argument("--lerobot", metavar="PYTHON")
    for hidden in ("--echo", "--serve", "--certificates"):
        parser.add_argument(hidden, help=argparse.SUPPRESS)
    given = parser.parse_args()
    logging.disable(logging.CRITICAL)
    certificates = Path(given.certificates) if given.certificates else None
    if given.echo:
        echo(int(given.echo), certificates)
        return 0
    if given.serve:
        serve(given.serve, certificates)
        return 0
    with plugin("null_parts", PLUGIN) as folder:
        return run(given, folder)


if __name__ == "__main__":
    sys.exit(main())

"""`ibrobot serve` with certificates in front of an openpi server, which itself asks nobody for anything."""

from __future__ import annotations

import contextlib
import re
import signal
import subprocess
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import pytest
import yaml
from ibrobot_policy_servers.openpi import OpenpiConnection
from ibrobot_policy_servers.options import ActionMap, ObservationMap, OpenpiOptions
from ibrobot_policy_servers.served import ServedPolicy
from ibrobot_serve.remote import RemoteEngine
from ibrobot_testing import host_context
from ibrobot_testing.contexts import ARM, GRIPPER
from ibrobot_testing.ports import free_port
from ibrobot_zenoh.options import Tls
from openpi_server import OpenpiServer

from ibrobot_core.errors import PolicyError
from ibrobot_core.plugins import installed_plugins

pytestmark = pytest.mark.integration

STATE = "observation.state"
JOINTS = ARM + GRIPPER
OPTIONS = OpenpiOptions(
    url="ws://127.0.0.1:1",  # robots do not connect to it
    observations=(ObservationMap(STATE, ("state",), (6,)),),
    actions=(ActionMap(JOINTS),),
    horizon=10,
    rate_hz=30.0,
    prompt=(),
)


@attrs.frozen
class Front:
    """The server in front."""

    process: subprocess.Popen[str]
    endpoint: str
    metrics: str
    lab: Path


def echo(request: dict[str, Any]) -> dict[str, Any]:
    """The state, ten times."""
    return {"actions": np.repeat(request["state"][None], 10, axis=0)}


@pytest.fixture(scope="module", autouse=True)
def _zenoh_runs() -> None:
    """Zenoh's own threads run, with the files that they keep."""
    zenoh = installed_plugins().find("transport", "zenoh")
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    router = zenoh.make(zenoh.options(mode="router", listen=(endpoint,)), host_context())
    zenoh.make(zenoh.options(connect=(endpoint,)), host_context()).close()
    router.close()


@pytest.fixture
def openpi() -> Iterator[OpenpiServer]:
    with OpenpiServer(echo) as server:
        yield server


@pytest.fixture
def front(ibrobot: tuple[str, ...], openpi: OpenpiServer, tmp_path: Path) -> Iterator[Front]:
    lab, endpoint, port = tmp_path / "lab", f"tls/127.0.0.1:{free_port()}", free_port()
    names = ("--server", "127.0.0.1", "--robot", "robot1", "--robot", "robot2")
    subprocess.run([*ibrobot, "certs", str(lab), *names], check=True, capture_output=True)
    model = {
        "type": "openpi",
        "url": openpi.url,
        "horizon": 10,
        "rate_hz": 30,
        "prompt": [],
        "observations": [{"observation": STATE, "key": ["state"], "shape": [6]}],
        "actions": [{"joints": list(JOINTS)}],
    }
    tls = {name: str(path) for name, path in attrs.asdict(certificates(lab, "127.0.0.1")).items()}
    given = {"models.pi": model, "transport": {"type": "zenoh", "tls": tls}}
    overrides = [
        part
        for path, value in given.items()
        for part in ("--set", f"{path}={yaml.safe_dump(value, default_flow_style=True, width=10_000).strip()}")
    ]
    serve = ("serve", "so101_blind", "--model", "pi", "--listen", endpoint, "--metrics-port", str(port))
    process = subprocess.Popen(
        [*ibrobot, *serve, *overrides], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    line = process.stdout.readline()
    assert line.startswith("serving pi"), process.communicate()[1]
    yield Front(process, endpoint, f"http://127.0.0.1:{port}/metrics", lab)
    process.kill()
    process.communicate()


def certificates(lab: Path, name: str) -> Tls:
    folder = lab / name
    robots = folder / "robots.txt"
    ca, certificate, key = (folder / file for file in ("ca.pem", "certificate.pem", "key.pem"))
    return Tls(ca, certificate, key, robots if robots.exists() else None)


@contextmanager
def robot(front: Front, tls: Tls | None, says: str = "so101") -> Iterator[RemoteEngine]:
    """A robot's side of the model, with its certificate, whatever it says that its name is."""
    zenoh = installed_plugins().find("transport", "zenoh")
    endpoint = front.endpoint if tls is not None else front.endpoint.replace("tls/", "tcp/")
    network = zenoh.make(zenoh.options(connect=(endpoint,), tls=tls), host_context())
    policy = ServedPolicy(OPTIONS, host_context(), OpenpiConnection(OPTIONS, host_context().log))
    engine = RemoteEngine(policy, network, "pi", says, start_timeout_s=60.0 if tls is not None else 1.0)
    try:
        yield engine
    finally:
        engine.close()
        network.close()


def metric(front: Front, name: str) -> float:
    """The value of a metric of the server."""
    with urllib.request.urlopen(front.metrics, timeout=60) as page:
        (value,) = re.findall(rf"^ibrobot_serve_{name}{{.*}} (\S+)$", page.read().decode(), re.MULTILINE)
    return float(value)


def test_a_greedy_robot_waits_in_one_place_whatever_names_it_gives(front: Front, openpi: OpenpiServer) -> None:
    """Three requests of one certificate, by three names: the newest takes the place of the one that waits."""
    gate = threading.Semaphore(0)

    def slow(request: dict[str, Any]) -> dict[str, Any]:
        gate.acquire()
        return echo(request)

    with contextlib.ExitStack() as stack:
        engines = [
            stack.enter_context(robot(front, certificates(front.lab, name), says))
            for name, says in (("robot1", "a"), ("robot1", "b"), ("robot1", "c"), ("robot2", "d"))
        ]
        for engine in engines:
            engine.start()
        begun, openpi.answer = len(openpi.requests), slow
        pool = stack.enter_context(ThreadPoolExecutor(4))
        stack.callback(gate.release, 4)

        def asked(number: int) -> Future[Any]:
            state = np.full(6, number, np.float32)
            return pool.submit(engines[number].infer, {STATE: state}, number, time.monotonic_ns() + 200_000_000_000)

        def until(done: Callable[[], bool]) -> None:
            while not done():
                time.sleep(0.02)

        first = asked(0)
        until(lambda: len(openpi.requests) > begun)
        second = asked(1)
        until(lambda: metric(front, "waiting") == 1)
        third = asked(2)
        with pytest.raises(PolicyError, match="replaced by the newer request"):
            second.result(120)
        other = asked(3)
        until(lambda: metric(front, "waiting") == 2)
        gate.release(4)
        for number, future in ((0, first), (2, third), (3, other)):
            assert np.asarray(future.result(120)["action"])[0, 0] == number
    assert [request["state"][0] for request in openpi.requests[begun:]] == [0, 2, 3]


def test_robots_are_who_their_certificates_say_and_others_get_nothing(front: Front, openpi: OpenpiServer) -> None:
    for name, says in (("robot1", "so101"), ("robot2", "robot1")):
        with robot(front, certificates(front.lab, name), says) as engine:
            engine.start()
            for number in range(1, 4):
                state = np.full(6, number / 10 + (name == "robot2"), np.float32)
                answer = engine.infer({STATE: state}, number, time.monotonic_ns() + 60_000_000_000)
                np.testing.assert_allclose(np.asarray(answer["action"], float), np.tile(state, (10, 1)), atol=1e-6)
            assert openpi.url in engine.stats.server
    with urllib.request.urlopen(front.metrics, timeout=60) as page:
        metrics = page.read().decode()
    answered = dict(re.findall(r'ibrobot_serve_robot_answered_total\{model="pi",robot="([^"]*)"\} (\S+)', metrics))
    assert answered == {"robot1": "3.0", "robot2": "3.0"}
    asked = len(openpi.requests)
    with robot(front, None) as stranger, pytest.raises(PolicyError, match="no server for model 'pi'"):
        stranger.start()
    assert len(openpi.requests) == asked
    front.process.send_signal(signal.SIGTERM)
    out, _ = front.process.communicate(timeout=60)
    assert "6 requests, 6 answered, 0 expired, 0 malformed" in out

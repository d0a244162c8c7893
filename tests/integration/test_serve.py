"""`ibrobot serve` as a user runs it: robots reach it over the network, and what becomes of models that die."""

from __future__ import annotations

import json
import os
import re
import select
import signal
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from ibrobot_serve.remote import RemoteEngine
from ibrobot_testing import host_context
from ibrobot_testing.fakes import FakePolicy
from ibrobot_testing.ports import free_port

from ibrobot_core.errors import PolicyError
from ibrobot_core.interfaces import Transport
from ibrobot_core.plugins import installed_plugins

if TYPE_CHECKING:
    from ibrobot_testing.site import Site

    from tests.integration.conftest import Log, Ran

pytestmark = pytest.mark.integration

ROOT = Path(__file__).parents[2]
MODE = "control_modes.model_inference.inference.execution_mode={}"
PATIENT = ("--set", "control_modes.model_inference.inference.request_timeout=60")


def free_endpoint() -> str:
    """An address of this machine that nobody listens on."""
    return f"tcp/127.0.0.1:{free_port()}"


@pytest.fixture
def endpoint() -> str:
    """An address of this machine that nobody listens on."""
    return free_endpoint()


@pytest.fixture(scope="module")
def connect() -> Callable[..., Transport]:
    """Makes a transport to a router. Zenoh's own threads run already, with the files that they keep."""
    zenoh = installed_plugins().find("transport", "zenoh")

    def made(**options: Any) -> Transport:
        transport: Transport = zenoh.make(zenoh.options(**options), host_context())
        return transport

    first = free_endpoint()
    router = made(mode="router", listen=(first,))
    made(connect=(first,)).close()
    router.close()
    return made


@pytest.fixture
def server(ibrobot: tuple[str, ...], endpoint: str) -> Iterator[subprocess.Popen[str]]:
    """The scripted pick, served."""
    command = [*ibrobot, "serve", "so101_blind", "--set", "transport={type: zenoh}", "--listen", endpoint]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert re.fullmatch(r"serving scripted_pick \(policy \w+\); Ctrl-C ends\n", process.stdout.readline())
    yield process
    process.kill()
    process.communicate()


def test_all_execution_modes_pick_the_cube_by_the_same_motion(
    server: subprocess.Popen[str], endpoint: str, recorded: Callable[..., tuple[Ran, list[Log]]]
):
    network = f"transport={{type: zenoh, connect: [{endpoint}]}}"
    motions = {}
    for mode, more in {"monolithic": (), "process": (), "distributed": ("--set", network)}.items():
        ran, logs = recorded(
            "--lockstep", "--episodes", "2", "--seed", "3", "--set", MODE.format(mode), *PATIENT, *more, dataset=mode,
            child=mode != "monolithic",
        )  # fmt: skip
        assert (ran.code, ran.summary["successes"]) == (0, 2), ran.err
        motions[mode] = np.concatenate([log.positions for log in logs])
    for mode in ("process", "distributed"):
        np.testing.assert_array_equal(motions[mode], motions["monolithic"])
    server.send_signal(signal.SIGTERM)
    out, _ = server.communicate(timeout=120)
    assert server.returncode == 0
    assert re.search(r"[1-9]\d* requests, (\d+) answered, 0 expired, 0 malformed, 0 waiting", out)


def test_a_model_process_ends_with_a_host_that_was_killed(ibrobot: tuple[str, ...], tmp_path: Path):
    command = [*ibrobot, "launch", "so101_blind", "--sim", "--headless", "--set", MODE.format("process")]
    host = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, text=True)
    try:
        assert host.stdout is not None
        while "model answers" not in host.stdout.readline():
            assert host.poll() is None
        children = (Path(f"/proc/{host.pid}/task/{host.pid}/children")).read_text().split()
        model = [int(pid) for pid in children if "model_process" in Path(f"/proc/{pid}/cmdline").read_text()]
        assert len(model) == 1
        end = os.pidfd_open(model[0])  # before it can be gone
    finally:
        host.kill()
        host.communicate()
    try:
        assert select.select([end], [], [], 30.0)[0], "the model's process is still there"
    finally:
        os.close(end)


def test_a_server_that_is_killed_in_the_middle_of_requests_harms_nothing():
    command = [sys.executable, str(ROOT / "tests/shared/server_kill.py"), "--kills", "2", "--slack", "5"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert json.loads(done.stdout.splitlines()[-1])["answered_twice"] == 0


def test_a_server_whose_model_hangs_starts_again(
    ibrobot: tuple[str, ...], endpoint: str, connect: Callable[..., Transport], site: Site, tmp_path: Path
):
    site.add("hangs-once", "hangs_once.py")
    port = free_port()
    command = [*ibrobot, "serve", str(tmp_path), "--type", "hangs_once", "--name", "net", "--listen", endpoint]
    process = subprocess.Popen(
        [*command, "--hang-timeout", "0.5", "--metrics-port", str(port)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    network = connect(connect=(endpoint,))
    remote = RemoteEngine(FakePolicy(host_context()), network, "net", "so101", start_timeout_s=60.0)
    tensors = {"x": np.zeros(1)}
    try:
        remote.start()
        with pytest.raises(PolicyError, match=r"the model hangs: it has worked on .* more than 0\.5 s"):
            remote.infer(tensors, 1, time.monotonic_ns() + 60_000_000_000)
        assert process.stdout is not None
        served = process.stdout.readline()
        assert served.startswith("serving net")
        while process.stdout.readline() != served:
            assert process.poll() is None
        remote.start()
        answer = remote.infer(tensors, 2, time.monotonic_ns() + 60_000_000_000)
        assert answer["pid"].tolist() == [process.pid], "in the same process, with a new program"
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=60) as page:
            assert 'ibrobot_serve_answered_total{model="net"} 1.0\n' in page.read().decode()
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/readyz", timeout=60) as page:
            assert page.read() == b"ok\n"
        process.send_signal(signal.SIGTERM)
        out, err = process.communicate(timeout=60)
        assert process.returncode == 0
        assert "1 request, 1 answered" in out
        assert "E the server restarts, with the same command line" in err
    finally:
        remote.close()
        network.close()
        process.kill()
        process.communicate()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("so101_blind",), "names no transport to robots"),
        (("so101_blind", "--model", "other"), "one of scripted_pick"),
        (("nowhere", "--type", "scripted_pick"), "no such folder"),
        ((".", "--type", "nothing_of_this_name"), "nothing_of_this_name"),
        ((".",), ". is a folder: name the plugin of its model"),
    ],
)
def test_a_wrong_command_line_is_reported(
    ibrobot: tuple[str, ...], arguments: tuple[str, ...], said: str, tmp_path: Path
):
    done = subprocess.run([*ibrobot, "serve", *arguments], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert said in done.stderr.replace("\n", " ")

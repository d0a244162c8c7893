"""A program moves a simulated SO-101 over the network, by the client of planning."""

from __future__ import annotations

import logging
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from ibrobot_planning.client import Client
from ibrobot_testing import host_context
from ibrobot_testing.ports import free_port

from ibrobot_core.api import Int8, TransportError
from ibrobot_core.app import LaunchRequest, Runtime, Session, find_config, installed_plugins, load_config

pytestmark = pytest.mark.integration
PAGE = Path(__file__).parents[2] / "docs/how-to/move-from-a-program.md"


def free_endpoint() -> str:
    return f"tcp/127.0.0.1:{free_port()}"


@pytest.fixture(scope="module")
def _zenoh_runs() -> None:
    """Zenoh's own threads run, with the files that they keep."""
    zenoh = installed_plugins().find("transport", "zenoh")
    first = free_endpoint()
    router = zenoh.make(zenoh.options(mode="router", listen=(first,), shared_memory=False), host_context())
    zenoh.make(zenoh.options(connect=(first,), shared_memory=False), host_context()).close()
    router.close()


@pytest.fixture
def endpoint(_zenoh_runs: None) -> str:
    return free_endpoint()


@pytest.fixture
def arm(endpoint: str) -> Iterator[Runtime]:
    """A simulated SO-101 with a table, which shares the services that the page shares."""
    registry = installed_plugins()
    shared = re.findall(r"^      - (/\S+)$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    config = load_config(
        find_config("so101_blind", registry),
        sim=True,
        mode="moveit_planning",
        registry=registry,
        overrides=(
            "simulation.scene=empty",
            "simulation.start_pose=home",
            "control_modes.moveit_planning.planner={type: rrt_connect}",
            "world={objects: {table: {shape: box, size: [0.8, 0.8, 0.02], position: [0.2, 0, -0.05]}}}",
            f"transport={{type: zenoh, mode: router, listen: [{endpoint}], shared_memory: false, namespace: arm1, "
            f"share: {{services: [{', '.join(shared)}]}}}}",
            "teleoperation.twist={type: twist}",
            "control_modes.servo={executors: [arm_position, gripper_position], teleop: twist}",
        ),
    )
    runtime = Runtime(Session(config, registry, LaunchRequest()))
    try:
        runtime.start()
        yield runtime
    finally:
        runtime.stop()


def test_program_moves_a_robot_over_the_network(arm: Runtime, endpoint: str):
    with Client.connect(f"connect=[{endpoint}]", "shared_memory=false", namespace="arm1") as client:
        assert client.go_to({"xyz": [0.25, 0.0, 0.12]}, velocity_scaling=0.5).wait().success
        place = client.fk().position
        assert (place.x, place.z) == pytest.approx((0.25, 0.12), abs=0.02)
        assert client.follow(client.plan("shoulder_pan=0.3")).wait().success
        assert client.joints()["shoulder_pan"] == pytest.approx(0.3, abs=0.05)


def test_programs_on_the_page_run(arm: Runtime, endpoint: str):
    pick, servo = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    here = f'Client.connect("connect=[{endpoint}]", "shared_memory=false", namespace="arm1")'
    assert pick.count("Client.connect()") == servo.count("Client.connect()") == 1
    codes = arm.session.bus.subscribe("/servo_node/status", 100)
    text = (pick + servo).replace("Client.connect()", here)
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, timeout=100, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert arm.session.state is not None
    assert arm.session.state.position[5] == pytest.approx(1.5, abs=0.1)
    twists = [received.message.data for received in codes.drain() if isinstance(received.message, Int8)]
    assert arm.session.mode == "moveit_planning"
    assert 0 in twists, "a busy machine may read some of them too late, which are refused"


def test_missing_robot_is_an_error(endpoint: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture):
    monkeypatch.setattr("ibrobot_planning.client._CONNECT_S", 0.2)
    caplog.set_level(logging.CRITICAL)
    with pytest.raises(TransportError, match="nobody listens there"):
        Client.connect(f"connect=[{endpoint}]", "shared_memory=false")


@pytest.mark.parametrize(
    ("end", "code"),
    [
        ("", 0),
        pytest.param("client.close()", 0, marks=pytest.mark.long),
        pytest.param("sys.exit(3)", 3, marks=pytest.mark.long),
        ("raise ValueError", 1),
    ],
    ids=["nothing", "closed", "exit", "error"],
)  # fmt: skip
def test_program_ends_however_it_ends(arm: Runtime, endpoint: str, end: str, code: int):
    """With a client that nobody closes, too."""
    text = f"""\
import sys
from ibrobot_planning.client import Client
client = Client.connect("connect=[{endpoint}]", "shared_memory=false", namespace="arm1")
client.joints()
{end}
"""
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, timeout=100, check=False)
    assert done.returncode == code, done.stderr
    assert ("ValueError" in done.stderr) == (code == 1)

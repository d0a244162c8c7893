"""A recorded episode, played into a run by `ibrobot bag play`, and through it to a node of rclpy's."""

from __future__ import annotations

import subprocess
import sys
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from ibrobot_ros2 import encode
from ibrobot_testing.contexts import host_context
from ibrobot_testing.ports import free_port

from ibrobot_core.api import String
from ibrobot_core.app import installed_plugins

from .conftest import until

pytest.importorskip("ibrobot_zenoh")
from ibrobot_zenoh.options import ZenohOptions
from ibrobot_zenoh.transport import ZenohTransport

NOTE, COMMANDS = "/note", "/arm/commands"
COUNT = 30


@pytest.fixture(scope="module", autouse=True)
def _zenoh_runs() -> None:
    """Zenoh's own threads run, with the files that they keep."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    both = (
        ZenohOptions(mode="router", listen=(endpoint,), shared_memory=False),
        ZenohOptions(connect=(endpoint,), shared_memory=False),
    )
    for each in [ZenohTransport(options, host_context()) for options in both][::-1]:
        each.close()


@pytest.fixture
def episode(start, tmp_path):
    """An episode in which the robot moved, with notes 20 ms apart."""
    run = start("recording={type: mcap, topics: all}", mode="teleop", by_operator=True)
    run.session.bus.call("/record_episode/start")
    begun = run.session.clock.now_ns()
    for i in range(COUNT):
        run.session.clock.sleep_until(begun + i * 20_000_000)
        run.session.bus.publish(NOTE, String(f"note {i}"))
    run.session.bus.call("/record_episode/stop", "success")
    run.runtime.stop()
    return tmp_path / "episodes/default/episodes/episode_000001"


def heard(peer):
    """The notes that came to rclpy."""
    return [raw for _, raw in peer.ask("take", topic=NOTE) if b"note" in bytes.fromhex(raw)]


def test_an_episode_goes_through_a_run_to_ros(start, episode, peer):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    subscribe = f"{{{NOTE}: std_msgs/msg/String}}"  # a run takes no commands: it refuses to subscribe to its actions
    transport = (
        f"{{type: zenoh, mode: router, listen: [{endpoint}], shared_memory: false, share: {{subscribe: {subscribe}}}}}"
    )
    run = start(f"transport={transport}", mode="idle")
    seen = run.session.bus.subscribe(NOTE, 1000)
    run.session.bus.publish(NOTE, String("first"))
    peer.ask("subscribe", topic=NOTE, type="std_msgs/msg/String")
    until(lambda: run.session.bus.publish(NOTE, String("here?")) or peer.ask("take", topic=NOTE, timeout_s=0.1))
    began = run.session.measured().position.copy()
    seen.drain()
    for options in (["--topics", NOTE, "--rate", "2", "--start-offset", "0.1"], []):
        play = [str(Path(sys.executable).with_name("ibrobot")), "bag", "play", str(episode), "--endpoint", endpoint]
        played = subprocess.run([*play, *options], check=False, capture_output=True, text=True)
        assert played.returncode == 0, played.stderr
    assert f"not played, as they command a robot: {COMMANDS}" in played.stderr
    with closing(installed_plugins().open_episode(episode)) as reader:
        recorded = list(reader.messages((NOTE,)))
        later = [each.message for each in reader.messages_since(reader.summary().start_ns + 100_000_000, [NOTE])]
    notes = [each.message for each in recorded]
    until(lambda: len(heard(peer)) >= len(later) + COUNT)
    wire = heard(peer)
    expected = [encode(each).hex() for each in (*later, *notes)]
    assert [raw[: len(text)] for raw, text in zip(wire, expected, strict=True)] == expected
    received = [each for each in seen.drain() if str(each.message.data).startswith("note")]
    assert [each.message for each in received] == [*later, *notes]
    pace = [
        (each[-1].received_ns - each[0].received_ns) / 1e9 for each in (received[: len(later)], received[len(later) :])
    ]
    spans = [(recorded[-1].received_ns - recorded[-len(later)].received_ns) / 2e9, 0.02 * (COUNT - 1)]
    np.testing.assert_allclose(pace, spans, atol=0.5)
    np.testing.assert_allclose(run.session.measured().position, began, atol=1e-6)
    assert not run.session.faults

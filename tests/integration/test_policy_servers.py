"""`ibrobot serve` in front of an openpi server: robots reach its model by `execution_mode: distributed`."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from click.testing import CliRunner
from fake_runs import runs, site
from ibrobot_policy_servers.openpi import OpenpiConnection
from ibrobot_policy_servers.options import ActionMap, ObservationMap, OpenpiOptions
from ibrobot_policy_servers.served import ServedPolicy
from ibrobot_serve.service import InferenceService
from ibrobot_testing import host_context
from ibrobot_testing.command import command_line
from ibrobot_testing.fakes import FakeTransport
from openpi_server import OpenpiServer, towards_a_goal

if TYPE_CHECKING:
    from fake_runs import Runs
    from ibrobot_testing.site import Site

    from ibrobot_core.launch.runtime import Runtime

episodes = command_line("episodes")

__all__ = ["runs", "site"]
pytestmark = pytest.mark.integration

MODEL = (
    "models.net={{type: openpi, url: '{url}', observations: [{{observation: observation.state, key: [state], "
    "shape: [2]}}], actions: [{{joints: [pan, grip]}}], horizon: 10, rate_hz: 25, prompt: [], timeout: 30}}"
)
DISTRIBUTED = ("control_modes.policy.inference.execution_mode=distributed", "transport={type: shared}")


@pytest.fixture
def openpi(runs: Runs) -> Iterator[OpenpiServer]:
    for name in ("serve", "policy_servers"):
        runs.installed.extend(entry_points(group="ibrobot", name=name))
    with OpenpiServer(towards_a_goal) as server:
        yield server


@pytest.fixture
def front(runs: Runs, site: Site, openpi: OpenpiServer) -> Iterator[InferenceService]:
    """A server of the model `net`, on the transport `shared`, which asks the openpi server."""
    site.add("shared-network", "shared_network.py")
    options = OpenpiOptions(
        url=openpi.url,
        observations=(ObservationMap("observation.state", ("state",), (2,)),),
        actions=(ActionMap(("pan", "grip")),),
        horizon=10,
        rate_hz=25.0,
        prompt=(),
        timeout=30.0,
    )
    ctx = host_context(robot=runs.make(MODEL.format(url=openpi.url)).session.config.robot)
    policy = ServedPolicy(options, ctx, OpenpiConnection(options, ctx.log))
    policy.load()
    network = sys.modules["shared_network"].NETWORK
    service = InferenceService(policy, network, "net")
    service.start()
    yield service
    service.close()
    policy.close()
    FakeTransport.close(network)


def motion(runtime: Runtime) -> np.ndarray:
    """Commands of every tick until the run ends, shape (T, J)."""
    commands = []
    while not runtime.step():
        assert runtime.session.state is not None
        commands.append(runtime.session.state.command.copy())
    runtime.raise_failure()
    return np.array(commands)


def test_robots_move_as_with_the_openpi_server_itself(
    runs: Runs, openpi: OpenpiServer, front: InferenceService
) -> None:
    model = MODEL.format(url=openpi.url)
    direct = motion(runs.start(model, episodes=2, seed=5))
    assert np.ptp(direct, axis=0).min() > 0.05, "nothing moved"
    nowhere = MODEL.format(url="ws://127.0.0.1:1")  # the robot does not connect to it
    behind = motion(runs.start(nowhere, *DISTRIBUTED, episodes=2, seed=5))
    np.testing.assert_array_equal(behind, direct)
    assert front.statistics()["answered"] > 2


@pytest.mark.parametrize("engine", ["monolithic", "process", "distributed"])
def test_a_recording_tells_what_the_model_was_asked_and_answered(
    runs: Runs, openpi: OpenpiServer, front: InferenceService, engine: str, tmp_path: Path
) -> None:
    runs.installed.extend(each for name in ("data", "mcap") for each in entry_points(group="ibrobot", name=name))
    openpi.metadata = {"model": "pi05", "version": 3}
    transport = DISTRIBUTED[1:] if engine == "distributed" else ()
    mode = f"control_modes.policy.inference.execution_mode={engine}"
    runtime = runs.start(
        MODEL.format(url=openpi.url),
        mode,
        *transport,
        f"recording={{type: mcap, root: {tmp_path}, dataset: picks}}",
        episodes=1,
    )
    motion(runtime)
    runtime.stop()
    episode = tmp_path / "picks/episodes/episode_000001"
    found = json.loads(CliRunner().invoke(episodes, ["answers", str(episode), "--json"]).output)
    used = [each for each in found if each["outcome"] == "used"]
    assert len(used) > 2
    for each in used:
        assert openpi.url in each["server"]
        assert '"version": 3' in each["server"] or engine == "distributed"
        assert np.shape(each["actions"]) == (10, 2)
        assert each["weights"]
    assert sum(each["executed"] for each in used) > 10
    assert min(each["deviation_rad"] for each in used if each["deviation_rad"] is not None) < 0.02
    shown = CliRunner().invoke(episodes, ["answers", str(episode)]).output
    assert shown.splitlines()[0].startswith("model net, ")
    assert len(shown.splitlines()) == 2 + len(found)

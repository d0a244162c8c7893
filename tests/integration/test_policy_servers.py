"""`ibrobot serve` in front of an openpi server: robots reach its model by `execution_mode: distributed`."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from importlib.metadata import entry_points
from typing import TYPE_CHECKING

import numpy as np
import pytest
from fake_runs import runs, site
from ibrobot_policy_servers.openpi import OpenpiConnection
from ibrobot_policy_servers.options import ActionMap, ObservationMap, OpenpiOptions
from ibrobot_policy_servers.served import ServedPolicy
from ibrobot_serve.service import InferenceService
from ibrobot_testing import host_context
from ibrobot_testing.fakes import FakeTransport
from openpi_server import OpenpiServer, towards_a_goal

if TYPE_CHECKING:
    from fake_runs import Runs
    from ibrobot_testing.site import Site

    from ibrobot_core.launch.runtime import Runtime

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
        url=openpi.url, observations=(ObservationMap("observation.state", ("state",), (2,)),),
        actions=(ActionMap(("pan", "grip")),), horizon=10, rate_hz=25.0, prompt=(), timeout=30.0,
    )  # fmt: skip
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

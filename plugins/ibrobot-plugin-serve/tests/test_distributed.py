"""Where the model runs: the same motion in the host, in a process of its own, and on a server."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from importlib.metadata import entry_points
from typing import TYPE_CHECKING

import numpy as np
import pytest
from ibrobot_serve.service import InferenceService
from ibrobot_testing import host_context
from ibrobot_testing.fakes import FakeTransport

from ibrobot_core.api import DiagnosticArray
from ibrobot_core.app import ComponentFailed

if TYPE_CHECKING:
    from fake_runs import Runs
    from ibrobot_testing.site import Site

    from ibrobot_core.app import Runtime


MODE = "control_modes.policy.inference.execution_mode={}"
NETWORK = "transport={type: shared}"


@pytest.fixture(autouse=True)
def engines(runs: Runs) -> None:
    runs.installed.extend(entry_points(group="ibrobot", name="serve"))


@pytest.fixture
def cloud(runs: Runs, site: Site) -> Iterator[InferenceService]:
    """A server of the model `net`, on the transport `shared`."""
    site.add("shared-network", "shared_network.py")
    robot = runs.make().session.config.robot
    network, net = sys.modules["shared_network"].NETWORK, runs.parts.Net(host_context(robot=robot))
    service = InferenceService(net, network, "net")
    service.start()
    yield service
    service.close()
    FakeTransport.close(network)


def motion(runtime: Runtime) -> np.ndarray:
    """Commands of every tick until the run ends, shape (T, J)."""
    commands = []
    while not runtime.step():
        assert runtime.session.state is not None
        commands.append(runtime.session.state.command.copy())
    runtime.raise_failure()
    return np.array(commands)


@pytest.mark.parametrize("mode", ["process", "distributed"])
def test_every_execution_mode_moves_alike(mode: str, runs: Runs, cloud: InferenceService):
    here = motion(runs.start(episodes=3, seed=5))
    assert len(here) > 50
    assert np.ptp(here, axis=0).min() > 0.05, "nothing moved"
    loads = runs.parts.CALLS.count("load net")
    runtime = runs.start(
        MODE.format(mode), NETWORK if mode == "distributed" else "transport={type: local}", episodes=3, seed=5
    )
    elsewhere = motion(runtime)
    np.testing.assert_array_equal(elsewhere, here)
    assert runs.parts.CALLS.count("load net") == loads, "the robot's side loads no weights"


@pytest.mark.parametrize("mode", ["process", "distributed"])
def test_the_plan_to_be_continued_travels_with_the_request(mode: str, runs: Runs, site: Site):
    def commanded(*overrides: str, strategy: str) -> np.ndarray:
        dispatch = f"control_modes.policy.dispatch={{watermark: 7, strategy: {strategy}}}"
        return motion(runs.start("models.net.type=continuing", dispatch, *overrides, episodes=2, seed=5))

    site.add("shared-network", "shared_network.py")
    here = commanded(strategy="rtc")
    assert not np.array_equal(commanded(strategy="replace"), here)
    robot, network = runs.made[-1].session.config.robot, sys.modules["shared_network"].NETWORK
    service = InferenceService(runs.parts.Continuing(host_context(robot=robot)), network, "net")
    service.start()
    try:
        transport = NETWORK if mode == "distributed" else "transport={type: local}"
        np.testing.assert_array_equal(commanded(MODE.format(mode), transport, strategy="rtc"), here)
    finally:
        service.close()
        FakeTransport.close(network)


def test_diagnostics_tell_where_the_model_is_and_whether_it_answers(runs: Runs, cloud: InferenceService):
    runtime = runs.start(MODE.format("distributed"), NETWORK, duration_s=1.0)
    diagnostics = runtime.session.bus.subscribe("/diagnostics", 1)
    motion(runtime)
    received = diagnostics.get()
    diagnostics.close()
    assert received is not None
    assert isinstance(received.message, DiagnosticArray)
    (status,) = (status for status in received.message.status if status.name == "inference")
    values = {pair.key: pair.value for pair in status.values}
    assert (values["mode"], values["alive"], values["failures"]) == ("distributed", "True", "0")
    assert int(values["requests"]) > 0
    assert float(values["infer_ms"]) >= float(values["model_ms"]) > 0


def test_the_arm_holds_while_the_server_is_gone_and_goes_on_when_it_is_back(runs: Runs, cloud: InferenceService):
    runtime = runs.start(MODE.format("distributed"), NETWORK, "contract.max_duration_s=100", mode="policy", sim=True)
    runs.parts.Scene.success = lambda scene: False
    session = runtime.session
    while not (session.acting and session.acting.dispatch.chunks >= 2):
        runtime.step()
    cloud.close()
    stats = session.acting.dispatch
    chunks = stats.chunks
    while stats.failures < 2 or stats.plan_length:
        runtime.step()
    for _ in range(25):  # it comes to rest
        runtime.step()
    assert session.state is not None
    held = session.state.command.copy()
    for _ in range(20):
        runtime.step()
        np.testing.assert_array_equal(session.state.command, held)
    assert runtime.plan.link is not None
    transport = runtime.plan.link.transport
    again = InferenceService(runs.parts.Net(host_context(robot=session.config.robot)), transport, "net")
    again.start()
    try:
        while stats.chunks == chunks:
            runtime.step()
    finally:
        again.close()


def test_a_run_without_its_server_does_not_start(runs: Runs, cloud: InferenceService):
    cloud.close()
    with pytest.raises(ComponentFailed, match=r"model:net: no server for model 'net': nobody serves"):
        runs.start(MODE.format("distributed"), NETWORK, "control_modes.policy.inference.request_timeout=0.01")
    assert not runs.made[-1].session.has_control, "nothing is powered"


def test_another_policy_on_the_server_is_reported_with_both_sides(runs: Runs, cloud: InferenceService):
    made = runs.make(MODE.format("distributed"), NETWORK, "control_modes.policy.inference.server_model=other")
    other = runs.parts.Net(host_context())
    service = InferenceService(other, sys.modules["shared_network"].NETWORK, "other")
    service.start()
    try:
        with pytest.raises(ComponentFailed, match=r"action_size\n +robot: 2\n +server: 6"):
            made.start()
    finally:
        service.close()

"""A run whose model is on an openpi server that is killed, hangs, lies or restarts."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from openpi_server import OpenpiServer, towards_a_goal

from ibrobot_core.app import ComponentFailed

if TYPE_CHECKING:
    from fake_runs import Runs


MODEL = (
    "models.net={{type: openpi, url: '{url}', observations: [{{observation: observation.state, key: [state], "
    "shape: [2]}}], actions: [{{joints: [pan, grip]}}], horizon: 10, rate_hz: 25, prompt: [], timeout: {timeout}, "
    "start_timeout: 30}}"
)
ENDLESS = "contract.max_duration_s=1000"


@pytest.fixture
def server(runs: Runs) -> Iterator[OpenpiServer]:
    runs.installed.extend(entry_points(group="ibrobot", name="policy_servers"))
    with OpenpiServer(towards_a_goal) as server:
        yield server


@pytest.mark.parametrize("fault", ["killed", "hung", "nan", "shape", "error", "garbage"])
def test_the_arm_holds_after_its_plan_and_goes_on_when_the_server_is_well(
    runs: Runs, server: OpenpiServer, fault: str
) -> None:
    timeout = 0.2 if fault == "hung" else 30
    runtime = runs.start(MODEL.format(url=server.url, timeout=timeout), ENDLESS, mode="policy", sim=True)
    runs.parts.Scene.success = lambda scene: False
    session = runtime.session
    while not (session.acting and session.acting.dispatch.chunks >= 2):
        runtime.step()
    stats = session.acting.dispatch
    answers: dict[str, Any] = {
        "hung": None,
        "nan": {"actions": np.full((10, 2), np.nan)},
        "shape": {"actions": np.zeros((10, 3))},
        "error": "Traceback: out of memory",
        "garbage": b"\xc1\xc1",
    }
    if fault == "killed":
        server.stop()
    else:
        server.answer = lambda request: answers[fault]
    failures = stats.failures
    while stats.failures < failures + 2 or stats.plan_length:
        runtime.step()
    for _ in range(25):  # it comes to rest
        runtime.step()
    assert session.state is not None
    chunks, held = stats.chunks, session.state.command.copy()
    for _ in range(20):
        runtime.step()
        np.testing.assert_array_equal(session.state.command, held)
    server.released.set()
    if fault == "killed":
        server.start()
    server.answer = towards_a_goal
    while stats.chunks == chunks:
        runtime.step()
    for _ in range(10):
        runtime.step()
    assert (session.state.command > held).all()


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        ({"actions": np.zeros((50, 2), np.float32)}, r"shape \(50, 2\), the robot YAML states \(10, 2\)"),
        ({"actions": np.full((10, 2), np.inf)}, "not finite"),
        ("KeyError: 'observation/state'", "KeyError"),
    ],
)
def test_a_run_does_not_start_with_a_server_that_does_not_fit(
    runs: Runs, server: OpenpiServer, answer: Any, message: str
) -> None:
    server.answer = lambda request: answer
    with pytest.raises(ComponentFailed, match=message):
        runs.start(MODEL.format(url=server.url, timeout=30))
    assert not runs.made[-1].session.has_control, "nothing is powered"


def test_a_run_does_not_start_without_its_server(runs: Runs, server: OpenpiServer) -> None:
    server.stop()
    with pytest.raises(ComponentFailed, match=f"{server.url}: no openpi server"):
        runs.start(MODEL.format(url=server.url, timeout=30))
    assert not runs.made[-1].session.has_control, "nothing is powered"
    server.start()

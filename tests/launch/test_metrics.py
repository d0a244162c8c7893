"""The metrics plugin in a run: what is on /diagnostics, for Prometheus, and whether the robot is well."""

from __future__ import annotations

import urllib.error
import urllib.request
from importlib.metadata import entry_points
from typing import TYPE_CHECKING

import pytest
from prometheus_client.parser import text_string_to_metric_families

from ibrobot_core.errors import ComponentFailed, ConfigError, SensorError

if TYPE_CHECKING:
    from fake_runs import Runs
    from ibrobot_testing.site import Site

    from ibrobot_core.launch.runtime import Runtime


pytestmark = pytest.mark.integration


@pytest.fixture(autouse=True)
def installed(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    """The plugin beside the fakes."""
    made_up = site.entry_points
    plugin = entry_points(group="ibrobot", name="metrics")
    monkeypatch.setattr(type(site), "entry_points", lambda _: [*made_up(), *plugin])


def url(runtime: Runtime) -> str:
    from ibrobot_metrics.component import MetricsPort  # the plugin is installed where integration tests run

    (port,) = (component for component in runtime.plan.components if component.name == "metrics")
    assert isinstance(port, MetricsPort)
    return port.url


def get(runtime: Runtime, path: str) -> tuple[int, str]:
    try:
        with urllib.request.urlopen(url(runtime).replace("/metrics", path), timeout=30) as page:
            return page.status, page.read().decode()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read().decode()


@pytest.fixture
def runtime(runs: Runs) -> Runtime:
    runtime = runs.start("metrics.port=0", episodes=2)
    while runtime.session.acting is None or runtime.session.acting.dispatch.chunks < 2:
        runtime.step()
    return runtime


def test_prometheus_learns_what_diagnostics_tell(runtime: Runtime):
    status, text = get(runtime, "/metrics")
    assert status == 200
    families = {family.name: family for family in text_string_to_metric_families(text)}
    assert runtime.session.acting is not None
    stats = runtime.session.acting.dispatch
    assert stats is not None
    for name, kind, value in (
        ("ibrobot_dispatch_chunks", "counter", stats.chunks),
        ("ibrobot_dispatch_requests", "counter", stats.requests),
        ("ibrobot_dispatch_plan_length", "gauge", stats.plan_length),
        ("ibrobot_dispatch_latency_seconds", "gauge", stats.latency_ms / 1e3),
        ("ibrobot_inference_alive", "gauge", 1),
        ("ibrobot_estop", "gauge", 0),
    ):
        (sample,) = families[name].samples
        assert families[name].type == kind
        assert sample.value == pytest.approx(value)
        assert sample.labels == {"robot": "mini"}
    assert families["ibrobot_mode"].samples[0].labels == {"robot": "mini", "mode": "policy"}
    assert {sample.labels["name"] for sample in families["ibrobot_sensor_rate_hertz"].samples} == {"top", "side"}
    assert "ibrobot_loop_ticks" in families


def test_a_robot_is_ready_unless_it_is_stopped_or_its_model_is_gone(runtime: Runtime):
    assert get(runtime, "/readyz") == (200, "ok\n")
    assert runtime.session.acting is not None
    stats = runtime.session.acting.engine
    assert stats is not None
    stats.alive = False
    assert get(runtime, "/readyz") == (503, "the model is gone\n")
    runtime.session.emergency_stop()
    runtime.step()
    assert get(runtime, "/readyz") == (503, "the emergency stop is latched\n")
    assert get(runtime, "/healthz") == (200, "ok\n")


def test_a_run_that_failed_is_unhealthy(runtime: Runtime):
    runtime.session.fail("sensor:top", SensorError("unplugged"))
    assert get(runtime, "/healthz") == (503, "sensor:top: unplugged\n")


def test_without_the_section_nothing_listens(runs: Runs):
    runtime = runs.start()
    assert "metrics" not in {component.name for component in runtime.plan.components}


@pytest.mark.parametrize("port", ["-1", "65536", "true", "nine"])
def test_a_port_that_is_none_is_named(runs: Runs, port: str):
    with pytest.raises(ConfigError, match=r"metrics\.port"):
        runs.make(f"metrics.port={port}")


def test_a_port_that_is_taken_is_named(runtime: Runtime, runs: Runs):
    port = url(runtime).split(":")[2].split("/")[0]
    with pytest.raises(ComponentFailed, match=rf"metrics: port {port} of 127\.0\.0\.1 is not available"):
        runs.start(f"metrics.port={port}")

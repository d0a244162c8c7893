"""Metrics: what is published on `/diagnostics`, for Prometheus, and whether the robot is well."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, override

from ibrobot_core.component import Component
from ibrobot_core.config.schema import MetricsConfig
from ibrobot_core.launch.session import Session
from ibrobot_core.metrics import Metrics, MetricsProbes, MetricsServer

_NAMED_BY_KEY = {"interventions": "joint", "bus drops": "topic"}
"""Groups whose keys are names of joints or topics: they are labels."""
_GAUGES = frozenset({"plan_length", "watermark", "lateness_p50_us", "lateness_p99_us"})
"""Whole numbers that do not only grow."""


class MetricsPort(Component):
    """Serves the metrics of a run."""

    def __init__(self, session: Session, config: MetricsConfig, needs: tuple[str, ...]) -> None:
        super().__init__("metrics", f"/metrics, /healthz and /readyz on port {config.port} of this machine", needs)
        self._session = session
        self._config = config
        self._server: MetricsServer | None = None

    @property
    def url(self) -> str:
        """Where they are, once started."""
        assert self._server is not None
        return self._server.url

    @override
    def start(self) -> None:
        session = self._session
        probes = MetricsProbes(
            lambda metrics: collect(session, metrics), lambda: unhealthy(session), lambda: unready(session)
        )
        self._server = MetricsServer(self._config.port, probes)
        session.log.info("metrics on %s", self.url)

    @override
    def stop(self) -> None:
        server, self._server = self._server, None
        if server is not None:
            server.close()


def collect(session: Session, metrics: Metrics) -> None:
    """Add all numbers of a run."""
    robot = {"robot": session.config.robot.name}
    state, outcome = session.state, session.outcome
    metrics.add("mode", 1, {**robot, "mode": session.mode}, about="the mode that is active")
    metrics.add("estop", state is not None and state.estop, robot, about="whether the emergency stop is latched")
    metrics.add("faults", len(outcome.faults), robot, counter=True)
    metrics.add("episodes", outcome.episodes, robot, counter=True)
    metrics.add("successes", outcome.successes, robot, counter=True)
    for group, values in session.counts().items():
        _collect_group(metrics, group, values, robot)


def _collect_group(metrics: Metrics, group: str, values: Mapping[str, Any], robot: Mapping[str, str]) -> None:
    """A group of `/diagnostics`: texts are left out."""
    if (label := _NAMED_BY_KEY.get(group)) is not None:
        for name, value in values.items():
            metrics.add(group, value, {**robot, label: name}, counter=True)
        return
    kind, _, name = group.partition(" ")
    labels = {**robot, "name": name} if name else robot
    for key, value in values.items():
        if isinstance(value, int | float):
            counter = isinstance(value, int) and not isinstance(value, bool) and key not in _GAUGES
            metrics.add(f"{kind}_{key}", value, labels, counter=counter)


def unhealthy(session: Session) -> str:
    """Why the run should be started again; empty where it should not."""
    return session.failure_text or ("the run is over" if session.finished.is_set() else "")


def unready(session: Session) -> str:
    """Why the robot does not do its work now; empty where it does."""
    state = session.state
    if state is None:
        return "no joint state has come yet"
    if state.estop:
        return "the emergency stop is latched"
    if state.stale:
        return "the hardware gives no joint states"
    if session.acting is not None and not session.acting.engine.alive:
        return "the model is gone"
    return ""

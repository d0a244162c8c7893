"""The component of the section: a port with the metrics and the health of a run."""

from __future__ import annotations

from typing import override

from ibrobot_http.probes import Probes, ProbeServer
from prometheus_client import generate_latest

from ibrobot_core.app import CONTROL, Component, RunView
from ibrobot_metrics.collector import RunCollector
from ibrobot_metrics.options import MetricsOptions


class MetricsPort(Component):
    """Serves the metrics of a run."""

    def __init__(self, options: MetricsOptions, session: RunView) -> None:
        summary = f"/metrics, /healthz and /readyz on port {options.port} of this machine"
        super().__init__("metrics", summary, (CONTROL,))
        self._session = session
        self._port = options.port
        self._server: ProbeServer | None = None

    @property
    def url(self) -> str:
        """URL of the metrics, once started."""
        assert self._server is not None
        return self._server.url

    @override
    def start(self) -> None:
        session = self._session
        collector = RunCollector(session)
        probes = Probes(lambda: generate_latest(collector), lambda: unhealthy(session), lambda: unready(session))
        self._server = ProbeServer(self._port, probes)
        session.log.info("metrics on %s", self.url)

    @override
    def stop(self) -> None:
        server, self._server = self._server, None
        if server is not None:
            server.close()


def unhealthy(session: RunView) -> str:
    """Why the run must be restarted; empty if it need not."""
    return session.failure_text or ("the run is over" if session.finished.is_set() else "")


def unready(session: RunView) -> str:
    """Why the robot cannot work now; empty if it can."""
    state = session.state
    if state is None:
        return "no joint state has been received yet"
    if state.estop:
        return "the emergency stop is latched"
    if state.stale:
        return "the hardware sends no joint states"
    if session.acting is not None and not session.acting.engine.alive:
        return "the model is gone"
    return ""

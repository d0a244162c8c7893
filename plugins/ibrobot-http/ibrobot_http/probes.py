"""A port for monitoring, on this machine alone: `/metrics` for Prometheus, `/healthz` and `/readyz`."""

from __future__ import annotations

from collections.abc import Callable

import attrs
from aiohttp import web

from ibrobot_http.addresses import LOCAL
from ibrobot_http.guard import Guard
from ibrobot_http.listener import listen
from ibrobot_http.server import ServerThread

_METRICS = "text/plain; version=0.0.4; charset=utf-8"


@attrs.frozen(eq=False)
class Probes:
    """Answers of a monitoring port. One function is called at a time, in the thread of the server."""

    metrics: Callable[[], bytes]
    """Returns all metrics, in Prometheus' text format 0.0.4."""
    unhealthy: Callable[[], str]
    """Returns why this process should be restarted; empty if it is healthy."""
    unready: Callable[[], str]
    """Returns why this process cannot do its work now; empty if it is ready."""


class ProbeServer:
    """Answers `GET /metrics`, `/healthz` and `/readyz` on the loopback interface, in a thread.

    Args:
        port: the port; 0 for any free port.
        probes: the answers.

    Raises:
        IbrobotError: if the port is not available.
    """

    def __init__(self, port: int, probes: Probes) -> None:
        listener = listen(LOCAL[0], port, LOCAL, of="metrics: ")
        self.url = f"{listener.url}/metrics"
        """The address of the metrics."""

        async def metrics(request: web.Request) -> web.StreamResponse:
            return web.Response(body=probes.metrics(), headers={"Content-Type": _METRICS})

        async def healthy(request: web.Request) -> web.StreamResponse:
            return _verdict(probes.unhealthy())

        async def ready(request: web.Request) -> web.StreamResponse:
            return _verdict(probes.unhealthy() or probes.unready())

        app = web.Application()
        for path, answer in (("/metrics", metrics), ("/healthz", healthy), ("/readyz", ready)):
            app.router.add_get(path, answer, allow_head=False)
        self._server = ServerThread(Guard(listener, any_port=True), app, "metrics")

    def close(self) -> None:
        """Stop. Safe to call twice."""
        self._server.close()


def _verdict(why_not: str) -> web.StreamResponse:
    status, text = (503, why_not) if why_not else (200, "ok")
    return web.Response(
        status=status, body=f"{text}\n".encode(errors="replace"), content_type="text/plain", charset="utf-8"
    )

"""A port for monitoring, on this machine alone: `/metrics` for Prometheus, `/healthz` and `/readyz`."""

from __future__ import annotations

import contextlib
import logging
import re
import socket
import threading
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, override

import attrs

from ibrobot_core.api import IbrobotError

_HOST = "127.0.0.1"
_NAMES = frozenset({"127.0.0.1", "localhost", "[::1]"})
"""Accepted host names in requests; others come from web pages whose name was redirected to this machine."""
_CLIENTS = 64
"""Clients at a time, at most; others are turned away."""
_REQUEST_S = 2.0
"""Time for a client to send its request and read the answer [s]."""
_TEXT = "text/plain; charset=utf-8"
_METRICS = "text/plain; version=0.0.4; charset=utf-8"
_log = logging.getLogger("ibrobot.metrics")


@attrs.frozen(eq=False)
class Probes:
    """Answers of a monitoring port. One function is called at a time, in threads of the server."""

    metrics: Callable[[], bytes]
    """Returns all metrics, in Prometheus' text format 0.0.4."""
    unhealthy: Callable[[], str]
    """Returns why this process should be restarted; empty if it is healthy."""
    unready: Callable[[], str]
    """Returns why this process cannot do its work now; empty if it is ready."""


class ProbeServer:
    """Answers `GET /metrics`, `/healthz` and `/readyz` on the loopback interface.

    Args:
        port: the port; 0 for any free port.
        probes: the answers.

    Raises:
        IbrobotError: if the port is not available.
    """

    def __init__(self, port: int, probes: Probes) -> None:
        handler = type("Handler", (_Handler,), {"probes": probes, "one_at_a_time": threading.Lock()})
        try:
            self._server = _Server((_HOST, port), handler)
        except OSError as error:
            raise IbrobotError(
                f"metrics: port {port} of {_HOST} cannot be had: {error.strerror}; choose another, or 0 for any"
            ) from None
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.1,), name="metrics", daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """The server's URL."""
        return f"http://{_HOST}:{self._server.server_port}/metrics"

    def close(self) -> None:
        """Stop. Safe to call twice."""
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()


class _Server(ThreadingHTTPServer):
    """One thread for each client, of which there may be a few: a silent one must not delay the others."""

    daemon_threads = False  # so that closing waits for them
    request_queue_size = _CLIENTS

    @override
    def server_activate(self) -> None:
        self._free = threading.BoundedSemaphore(_CLIENTS)
        super().server_activate()

    @override
    def verify_request(self, request: Any, client_address: Any) -> bool:
        return self._free.acquire(blocking=False)

    @override
    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()

    @override
    def handle_error(self, request: Any, client_address: Any) -> None:
        _log.debug("a client left", exc_info=True)


class _Handler(BaseHTTPRequestHandler):
    """Answers one request per connection."""

    probes: Probes
    one_at_a_time: threading.Lock
    server_version, sys_version = "ibrobot", ""
    timeout = _REQUEST_S
    """Timeout of each read and write [s]; a timer stops clients that send a byte now and then."""

    @override
    def setup(self) -> None:
        super().setup()
        self._timer = threading.Timer(_REQUEST_S, self._give_up)
        self._timer.daemon = True
        self._timer.start()

    @override
    def finish(self) -> None:
        self._timer.cancel()
        super().finish()

    def do_GET(self) -> None:
        """Answer."""
        hosts = self.headers.get_all("Host", [])
        if len(hosts) != 1 or re.sub(r":\d+$", "", hosts[0]).lower() not in _NAMES:
            self._reply(403, b"only clients on this machine may connect: use localhost or 127.0.0.1\n")
            return
        try:
            with self.one_at_a_time:
                answer = self._answer()
            self._reply(*answer)
        except Exception:  # noqa: BLE001 - contained: what fails here must not end the server
            _log.exception("metrics failed")
            self._reply(500, b"failed; see the log\n")

    def _answer(self) -> tuple[int, bytes, str]:
        match self.path.split("?", 1)[0]:
            case "/metrics":
                return 200, self.probes.metrics(), _METRICS
            case "/healthz":
                return _verdict(self.probes.unhealthy())
            case "/readyz":
                return _verdict(self.probes.unhealthy() or self.probes.unready())
            case _:
                return 404, b"available: /metrics, /healthz and /readyz\n", _TEXT

    def _refuse(self) -> None:
        self._reply(405, b"GET only\n")

    do_HEAD = do_POST = do_PUT = do_PATCH = do_DELETE = do_OPTIONS = do_TRACE = _refuse

    def _reply(self, status: int, body: bytes, kind: str = _TEXT) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        if status == 405:
            self.send_header("Allow", "GET")
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def _give_up(self) -> None:
        with contextlib.suppress(OSError):  # the connection may already be closed
            self.connection.shutdown(socket.SHUT_RDWR)

    @override
    def log_message(self, format: str, *args: Any) -> None:
        _log.debug("%s", format % args)


def _verdict(why_not: str) -> tuple[int, bytes, str]:
    return (503, f"{why_not}\n".encode(errors="replace"), _TEXT) if why_not else (200, b"ok\n", _TEXT)

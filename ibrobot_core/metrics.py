"""Metrics in Prometheus' text format, over HTTP on this machine alone, with `/healthz` and `/readyz`."""

from __future__ import annotations

import contextlib
import logging
import math
import re
import socket
import threading
from collections.abc import Callable, Mapping
from http.server import BaseHTTPRequestHandler, HTTPServer
from typing import Any, override

import attrs

from ibrobot_core.errors import IbrobotError

_HOST = "127.0.0.1"
_NAMES = frozenset({"127.0.0.1", "localhost", "[::1]"})
"""What a client may call this machine: a web page whose name was made to point here calls it otherwise."""
_REQUEST_S = 2.0
"""How long a client may take for its request, and for reading the answer [s]."""
_LABEL_SIZE = 200
_METRIC = re.compile(r"[a-zA-Z_:][a-zA-Z0-9_:]*")
_UNITS = {"_ms": ("_seconds", 1e-3), "_us": ("_seconds", 1e-6), "_s": ("_seconds", 1.0), "_hz": ("_hertz", 1.0)}
_TEXT = "text/plain; charset=utf-8"
_METRICS = "text/plain; version=0.0.4; charset=utf-8"
_log = logging.getLogger("ibrobot.metrics")

Labels = Mapping[str, str]


@attrs.define
class Family:
    """A metric and its values, by labels."""

    name: str
    kind: str
    """counter or gauge."""
    help: str
    samples: list[tuple[Labels, float]] = attrs.field(factory=list)


class Metrics:
    """Collects values, and writes them as text."""

    def __init__(self) -> None:
        self._families: dict[str, Family] = {}

    def add(self, name: str, value: float, labels: Labels, *, counter: bool = False, about: str = "") -> None:
        """Take in one value.

        Args:
            name: without the prefix `ibrobot_`; a unit at its end is changed to a base unit: `_ms` to `_seconds`.
            value: in the unit of the name.
            labels: any texts; they are escaped.
            counter: whether it only grows.
            about: help.
        """
        for suffix, (unit, factor) in _UNITS.items():
            if name.endswith(suffix):
                name, value = name.removesuffix(suffix) + unit, value * factor
                break
        name = "ibrobot_" + re.sub(r"[^a-zA-Z0-9_]", "_", name) + ("_total" if counter else "")
        kind = "counter" if counter else "gauge"
        self._families.setdefault(name, Family(name, kind, about)).samples.append((labels, float(value)))

    def text(self) -> str:
        """All of them, in Prometheus' text format 0.0.4."""
        lines = []
        for family in self._families.values():
            if family.help:
                lines.append(f"# HELP {family.name} {_escaped(family.help)}")
            lines.append(f"# TYPE {family.name} {family.kind}")
            lines += [f"{family.name}{_labels(labels)} {_number(value)}" for labels, value in family.samples]
        return "".join(f"{line}\n" for line in lines)


def _labels(labels: Labels) -> str:
    quoted = (f'{name}="{_escaped(value[:_LABEL_SIZE], quote=True)}"' for name, value in labels.items())
    return "{" + ",".join(quoted) + "}" if labels else ""


def _escaped(text: str, *, quote: bool = False) -> str:
    text = text.replace("\\", r"\\").replace("\n", r"\n")
    return text.replace('"', r"\"") if quote else text


def _number(value: float) -> str:
    if math.isfinite(value):
        return repr(int(value)) if value.is_integer() and abs(value) < 2**53 else repr(value)
    return "NaN" if math.isnan(value) else ("+Inf" if value > 0 else "-Inf")


@attrs.frozen(eq=False)
class MetricsProbes:
    """What is asked over HTTP. Each is called in the server's thread."""

    collect: Callable[[Metrics], object]
    """Adds all metrics."""
    unhealthy: Callable[[], str]
    """Why this process should be replaced; empty where it should not."""
    unready: Callable[[], str]
    """Why it cannot do its work now; empty where it can."""


class MetricsServer:
    """Answers `GET /metrics`, `/healthz` and `/readyz` on the loopback interface, one client after another.

    Args:
        port: 0 for any that is free.
        probes: what to say.

    Raises:
        IbrobotError: when the port cannot be had.
    """

    def __init__(self, port: int, probes: MetricsProbes) -> None:
        handler = type("Handler", (_Handler,), {"probes": probes})
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
        """Where it listens."""
        return f"http://{_HOST}:{self._server.server_port}/metrics"

    def close(self) -> None:
        """End. Safe to call twice."""
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()


class _Server(HTTPServer):
    @override
    def handle_error(self, request: Any, client_address: Any) -> None:
        _log.debug("a client left", exc_info=True)


class _Handler(BaseHTTPRequestHandler):
    """One request; then the connection ends."""

    probes: MetricsProbes
    server_version, sys_version = "ibrobot", ""
    timeout = _REQUEST_S
    """Of each read and write; a client that sends a byte now and then meets the timer."""

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
            self._say(403, "this is for clients on this machine: ask for localhost or 127.0.0.1\n")
            return
        try:
            self._say(*self._answer())
        except Exception:  # noqa: BLE001 - contained: what fails here must not end the server
            _log.exception("metrics failed")
            self._say(500, "failed; the log says why\n")

    def _answer(self) -> tuple[int, str, str]:
        match self.path.split("?", 1)[0]:
            case "/metrics":
                metrics = Metrics()
                self.probes.collect(metrics)
                return 200, metrics.text(), _METRICS
            case "/healthz":
                return _verdict(self.probes.unhealthy())
            case "/readyz":
                return _verdict(self.probes.unhealthy() or self.probes.unready())
            case _:
                return 404, "available: /metrics, /healthz and /readyz\n", _TEXT

    def _refuse(self) -> None:
        self._say(405, "GET only\n")

    do_HEAD = do_POST = do_PUT = do_PATCH = do_DELETE = do_OPTIONS = do_TRACE = _refuse

    def _say(self, status: int, text: str, kind: str = _TEXT) -> None:
        body = text.encode(errors="replace")
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
        with contextlib.suppress(OSError):  # it may be over already
            self.connection.shutdown(socket.SHUT_RDWR)

    @override
    def log_message(self, format: str, *args: Any) -> None:
        _log.debug("%s", format % args)


def _verdict(why_not: str) -> tuple[int, str, str]:
    return (503, f"{why_not}\n", _TEXT) if why_not else (200, "ok\n", _TEXT)

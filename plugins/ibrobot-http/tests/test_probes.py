"""The port for monitoring: who may ask it, how, and for how long."""

from __future__ import annotations

import http.client
from collections.abc import Iterator
from contextlib import closing, contextmanager
from typing import override
from unittest.mock import patch

import attrs
import pytest
from ibrobot_http.probes import Probes, ProbeServer
from ibrobot_testing.http import HttpSuite, Served

from ibrobot_core.api import IbrobotError


@attrs.define
class State:
    unhealthy: str = ""
    unready: str = ""
    broken: bool = False

    def metrics(self) -> bytes:
        if self.broken:
            raise ZeroDivisionError("one over nothing")
        return b"ibrobot_answer 42\n"


@pytest.fixture
def state() -> State:
    return State()


@pytest.fixture
def server(state: State) -> Iterator[ProbeServer]:
    made = ProbeServer(0, Probes(state.metrics, lambda: state.unhealthy, lambda: state.unready))
    yield made
    made.close()


def port(server: ProbeServer) -> int:
    return int(server.url.split(":")[2].split("/")[0])


def ask(server: ProbeServer, path: str, method: str = "GET", **headers: str) -> tuple[int, str, str]:
    connection = http.client.HTTPConnection("127.0.0.1", port(server), timeout=30)
    try:
        connection.request(method, path, headers=headers)
        response = connection.getresponse()
        return response.status, response.read().decode(), response.headers["Content-Type"]
    finally:
        connection.close()


class TestAttacks(HttpSuite):
    @override
    @contextmanager
    def serve(self, request_s: float) -> Iterator[Served]:
        with (
            patch("ibrobot_http.guard.REQUEST_S", request_s),
            closing(ProbeServer(0, Probes(lambda: b"", str, str))) as server,
        ):
            yield Served(server.url.removesuffix("/metrics"), ("/metrics", "/healthz", "/readyz"), any_port=True)


def test_metrics_are_served_as_prometheus_wants_them(server: ProbeServer):
    status, text, kind = ask(server, "/metrics?debug=1")
    assert (status, kind) == (200, "text/plain; version=0.0.4; charset=utf-8")
    assert text == "ibrobot_answer 42\n"


def test_health_and_readiness_say_why_not(server: ProbeServer, state: State):
    assert [ask(server, path)[:2] for path in ("/healthz", "/readyz")] == [(200, "ok\n")] * 2
    state.unready = "the model is gone"
    assert ask(server, "/healthz")[0] == 200
    assert ask(server, "/readyz")[:2] == (503, "the model is gone\n")
    state.unhealthy = "the model hangs"
    assert [ask(server, path)[:2] for path in ("/healthz", "/readyz")] == [(503, "the model hangs\n")] * 2


def test_reason_that_is_no_text_is_still_a_reason(server: ProbeServer, state: State):
    state.unhealthy = "no such file: \udcff.yaml"
    assert ask(server, "/healthz")[:2] == (503, "no such file: ?.yaml\n")


@pytest.mark.parametrize("host", ["localhost", "LOCALHOST:9464", "127.0.0.1:1", "[::1]:9464"])
def test_this_machine_may_be_called_by_its_names(server: ProbeServer, host: str):
    assert ask(server, "/metrics", Host=host)[0] == 200


def test_failing_metrics_do_not_end_the_server(server: ProbeServer, state: State, caplog: pytest.LogCaptureFixture):
    state.broken = True
    status, text, _ = ask(server, "/metrics")
    assert status == 500
    assert "one over nothing" not in text
    assert "ZeroDivisionError" in caplog.text
    state.broken = False
    assert ask(server, "/metrics")[0] == 200


def test_it_listens_on_this_machine_alone_and_a_port_that_is_taken_is_named(server: ProbeServer):
    assert server.url.startswith("http://127.0.0.1:")
    with pytest.raises(
        IbrobotError, match=rf"port {port(server)} of 127\.0\.0\.1 is not available: Address already in use"
    ):
        ProbeServer(port(server), Probes(bytes, str, str))

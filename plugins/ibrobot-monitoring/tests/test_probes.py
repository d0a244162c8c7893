"""The port for monitoring: who may ask it, how, and for how long."""

from __future__ import annotations

import http.client
import socket
import time
from collections.abc import Iterator

import attrs
import pytest
from ibrobot_monitoring import Probes, ProbeServer
from ibrobot_monitoring import probes as module

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


@pytest.mark.parametrize("host", ["example.org", "127.0.0.1.example.org:80", "localhost.", "", "127.0.0.2"])
def test_a_web_page_under_another_name_learns_nothing(server: ProbeServer, host: str):
    status, text, _ = ask(server, "/metrics", Host=host)
    assert status == 403
    assert "ibrobot_" not in text


def test_request_with_two_hosts_learns_nothing(server: ProbeServer):
    with socket.create_connection(("127.0.0.1", port(server)), timeout=30) as client:
        client.sendall(b"GET /metrics HTTP/1.1\r\nHost: localhost\r\nHost: example.org\r\n\r\n")
        assert b" 403 " in client.recv(100)


@pytest.mark.parametrize("host", ["localhost", "LOCALHOST:9464", "127.0.0.1:1", "[::1]:9464"])
def test_this_machine_may_be_called_by_its_names(server: ProbeServer, host: str):
    assert ask(server, "/metrics", Host=host)[0] == 200


@pytest.mark.parametrize("method", ["HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS", "TRACE"])
def test_only_get_is_taken(server: ProbeServer, method: str):
    assert ask(server, "/metrics", method)[0] == 405


def test_what_is_not_there_is_not_found(server: ProbeServer):
    assert ask(server, "/metrics/../../etc/passwd")[0] == 404


def test_metrics_that_fail_end_nothing(server: ProbeServer, state: State, caplog: pytest.LogCaptureFixture):
    state.broken = True
    status, text, _ = ask(server, "/metrics")
    assert status == 500
    assert "one over nothing" not in text
    assert "ZeroDivisionError" in caplog.text
    state.broken = False
    assert ask(server, "/metrics")[0] == 200


@pytest.mark.parametrize("sent", [b"", b"GET /metrics HTTP/1.1\r\nHost: localhost\r\nX-A: "], ids=["silent", "slow"])
def test_a_client_that_does_not_finish_keeps_nobody_waiting_for_long(
    server: ProbeServer, sent: bytes, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(module, "_REQUEST_S", 0.05)
    with socket.create_connection(("127.0.0.1", port(server))) as idle:
        idle.sendall(sent)
        assert ask(server, "/healthz")[0] == 200
        idle.settimeout(30)
        assert idle.recv(1) == b""


@pytest.mark.parametrize("sent", [b"GET /" + b"a" * 70_000 + b" HTTP/1.1\r\n\r\n", b"\x00\xff garbage\r\n\r\n"])
def test_garbage_and_too_much_harm_nothing(server: ProbeServer, sent: bytes, capsys: pytest.CaptureFixture[str]):
    with socket.create_connection(("127.0.0.1", port(server)), timeout=30) as client:
        client.sendall(sent)
    assert ask(server, "/healthz")[0] == 200
    assert capsys.readouterr() == ("", "")


def test_it_listens_on_this_machine_alone_and_a_port_that_is_taken_is_named(server: ProbeServer):
    assert server.url.startswith("http://127.0.0.1:")
    with pytest.raises(
        IbrobotError, match=rf"port {port(server)} of 127\.0\.0\.1 cannot be had: Address already in use"
    ):
        ProbeServer(port(server), Probes(bytes, str, str))


def test_silent_clients_do_not_delay_the_others(server: ProbeServer, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(module._Handler, "timeout", 3600)
    monkeypatch.setattr(module, "_REQUEST_S", 3600)
    silent = [socket.create_connection(("127.0.0.1", port(server)), timeout=30) for _ in range(5)]
    try:
        assert [ask(server, path)[0] for path in ("/healthz", "/readyz", "/metrics")] == [200] * 3
    finally:
        for client in silent:
            client.close()


def test_a_crowd_is_turned_away_until_some_leave(server: ProbeServer):
    crowd = [socket.create_connection(("127.0.0.1", port(server)), timeout=30) for _ in range(module._CLIENTS)]
    with socket.create_connection(("127.0.0.1", port(server)), timeout=30) as late:
        assert late.recv(1) == b""
    for client in crowd:
        client.close()
    deadline = time.monotonic() + 30
    while time.monotonic() < deadline:
        try:
            assert ask(server, "/healthz")[0] == 200
            return
        except (OSError, http.client.HTTPException):
            time.sleep(0.01)
    pytest.fail("nobody is served after the crowd has left")

"""Metrics: what a parser of others reads of them, and who may ask for them, how, and for how long."""

from __future__ import annotations

import http.client
import math
import socket
from collections.abc import Iterator

import attrs
import pytest
from hypothesis import given
from hypothesis import strategies as st
from prometheus_client.parser import text_string_to_metric_families

from ibrobot_core import metrics as module
from ibrobot_core.errors import IbrobotError
from ibrobot_core.metrics import Metrics, MetricsProbes, MetricsServer

TEXTS = st.text(st.characters(codec="utf-8"), max_size=60)
HOSTILE = 'a"} 1\nibrobot_forged{x="\\'


@given(
    st.dictionaries(TEXTS, st.floats(), min_size=1, max_size=5), st.booleans(),
    TEXTS.filter(lambda text: "\r" not in text),
)  # fmt: skip
def test_a_parser_reads_back_any_label_and_any_number(values: dict[str, float], counter: bool, about: str):
    metrics = Metrics()
    for label, value in values.items():
        metrics.add("some.thing/else", value, {"robot": label}, counter=counter, about=about)
    # The format ends lines by \n alone; this parser takes any that Python knows.
    (family,) = text_string_to_metric_families(_one_kind_of_line_end(metrics.text()))
    assert (family.name, family.type) == ("ibrobot_some_thing_else", "counter" if counter else "gauge")
    read = {sample.labels["robot"]: sample.value for sample in family.samples}
    expected = {_one_kind_of_line_end(label): value for label, value in values.items()}
    assert read.keys() == expected.keys()
    for label, value in read.items():
        assert value == expected[label] or math.isnan(value) == math.isnan(expected[label]) is True


def _one_kind_of_line_end(text: str) -> str:
    return "".join("?" if char in "\r\x0b\x0c\x1c\x1d\x1e\x85\u2028\u2029" else char for char in text)


def test_text_from_outside_adds_no_line_and_no_metric():
    metrics = Metrics()
    metrics.add("requests", 3, {"robot": HOSTILE}, counter=True, about=HOSTILE)
    lines = metrics.text().splitlines()
    assert [line.split(" ")[0] for line in lines] == ["#", "#", 'ibrobot_requests_total{robot="a\\"}']
    (family,) = text_string_to_metric_families(metrics.text())
    assert [sample.labels for sample in family.samples] == [{"robot": HOSTILE}]


@pytest.mark.parametrize(
    ("name", "value", "line"),
    [
        ("age_ms", 1500.0, "ibrobot_age_seconds 1.5"),
        ("lateness_p50_us", 250, "ibrobot_lateness_p50_seconds 0.00025"),
        ("rate_hz", 30.5, "ibrobot_rate_hertz 30.5"),
        ("uptime_s", 3.0, "ibrobot_uptime_seconds 3"),
        ("alive", True, "ibrobot_alive 1"),
        ("large", 2.0**60, f"ibrobot_large {2.0**60!r}"),
    ],
)
def test_units_are_base_units(name: str, value: float, line: str):
    metrics = Metrics()
    metrics.add(name, value, {})
    assert metrics.text().splitlines()[-1] == line


def test_a_long_label_is_cut():
    metrics = Metrics()
    metrics.add("a", 1, {"robot": "x" * 10_000})
    assert len(metrics.text()) < 300


@attrs.define
class State:
    unhealthy: str = ""
    unready: str = ""
    broken: bool = False

    def collect(self, metrics: Metrics) -> None:
        if self.broken:
            raise ZeroDivisionError("one over nothing")
        metrics.add("answer", 42, {"robot": "so101"})


@pytest.fixture
def state() -> State:
    return State()


@pytest.fixture
def server(state: State) -> Iterator[MetricsServer]:
    made = MetricsServer(0, MetricsProbes(state.collect, lambda: state.unhealthy, lambda: state.unready))
    yield made
    made.close()


def port(server: MetricsServer) -> int:
    return int(server.url.split(":")[2].split("/")[0])


def ask(server: MetricsServer, path: str, method: str = "GET", **headers: str) -> tuple[int, str, str]:
    connection = http.client.HTTPConnection("127.0.0.1", port(server), timeout=30)
    try:
        connection.request(method, path, headers=headers)
        response = connection.getresponse()
        return response.status, response.read().decode(), response.headers["Content-Type"]
    finally:
        connection.close()


def test_metrics_are_served_as_prometheus_wants_them(server: MetricsServer):
    status, text, kind = ask(server, "/metrics?debug=1")
    assert (status, kind) == (200, "text/plain; version=0.0.4; charset=utf-8")
    assert text == '# TYPE ibrobot_answer gauge\nibrobot_answer{robot="so101"} 42\n'


def test_health_and_readiness_say_why_not(server: MetricsServer, state: State):
    assert [ask(server, path)[:2] for path in ("/healthz", "/readyz")] == [(200, "ok\n")] * 2
    state.unready = "the model is gone"
    assert ask(server, "/healthz")[0] == 200
    assert ask(server, "/readyz")[:2] == (503, "the model is gone\n")
    state.unhealthy = "the model hangs"
    assert [ask(server, path)[:2] for path in ("/healthz", "/readyz")] == [(503, "the model hangs\n")] * 2


@pytest.mark.parametrize("host", ["example.org", "127.0.0.1.example.org:80", "localhost.", "", "127.0.0.2"])
def test_a_web_page_under_another_name_learns_nothing(server: MetricsServer, host: str):
    status, text, _ = ask(server, "/metrics", Host=host)
    assert status == 403
    assert "ibrobot_" not in text


@pytest.mark.parametrize("host", ["localhost", "LOCALHOST:9464", "127.0.0.1:1", "[::1]:9464"])
def test_this_machine_may_be_called_by_its_names(server: MetricsServer, host: str):
    assert ask(server, "/metrics", Host=host)[0] == 200


@pytest.mark.parametrize("method", ["HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS", "TRACE"])
def test_only_get_is_taken(server: MetricsServer, method: str):
    assert ask(server, "/metrics", method)[0] == 405


def test_what_is_not_there_is_not_found(server: MetricsServer):
    assert ask(server, "/metrics/../../etc/passwd")[0] == 404


def test_a_collector_that_fails_ends_nothing(server: MetricsServer, state: State, caplog: pytest.LogCaptureFixture):
    state.broken = True
    status, text, _ = ask(server, "/metrics")
    assert status == 500
    assert "one over nothing" not in text
    assert "ZeroDivisionError" in caplog.text
    state.broken = False
    assert ask(server, "/metrics")[0] == 200


@pytest.mark.parametrize("sent", [b"", b"GET /metrics HTTP/1.1\r\nHost: localhost\r\nX-A: "], ids=["silent", "slow"])
def test_a_client_that_does_not_finish_keeps_nobody_waiting_for_long(
    server: MetricsServer, sent: bytes, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(module, "_REQUEST_S", 0.05)
    with socket.create_connection(("127.0.0.1", port(server))) as idle:
        idle.sendall(sent)
        assert ask(server, "/healthz")[0] == 200
        idle.settimeout(30)
        assert idle.recv(1) == b""


@pytest.mark.parametrize("sent", [b"GET /" + b"a" * 70_000 + b" HTTP/1.1\r\n\r\n", b"\x00\xff garbage\r\n\r\n"])
def test_garbage_and_too_much_harm_nothing(server: MetricsServer, sent: bytes, capsys: pytest.CaptureFixture[str]):
    with socket.create_connection(("127.0.0.1", port(server)), timeout=30) as client:
        client.sendall(sent)
    assert ask(server, "/healthz")[0] == 200
    assert capsys.readouterr() == ("", "")


def test_it_listens_on_this_machine_alone_and_a_port_that_is_taken_is_named(server: MetricsServer):
    assert server.url.startswith("http://127.0.0.1:")
    with pytest.raises(
        IbrobotError, match=rf"port {port(server)} of 127\.0\.0\.1 cannot be had: Address already in use"
    ):
        MetricsServer(port(server), MetricsProbes(lambda metrics: None, str, str))

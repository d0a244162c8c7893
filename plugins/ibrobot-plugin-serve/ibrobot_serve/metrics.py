"""Counters of a model server for Prometheus, and its health."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, override

from ibrobot_http.probes import Probes
from prometheus_client import generate_latest
from prometheus_client.metrics_core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from ibrobot_serve.service import InferenceService

_COUNTS = ("requests", "answered", "failed", "expired")
_LABEL_SIZE = 200
_Rows = Mapping[tuple[str, ...], Mapping[str, Any]]
"""Values of the labels -> counts."""


def probes(service: InferenceService) -> Probes:
    """Answers of a service's monitoring port."""
    return Probes(
        lambda: generate_latest(ServiceCollector(service)),
        lambda: "the model hangs" if service.state == "hangs" else _failing(service),
        lambda: "the server is stopping" if service.state == "draining" else _failing(service),
    )


def _failing(service: InferenceService) -> str:
    error = service.failing
    return f"the model fails all requests: {error}" if error else ""


class ServiceCollector(Collector):
    """All numbers of a service, each with the label `model`."""

    def __init__(self, service: InferenceService) -> None:
        self._service = service

    @override
    def collect(self) -> Iterable[Metric]:
        """The present values of all numbers."""
        statistics = self._service.statistics()
        model = statistics["model"]
        malformed = CounterMetricFamily("ibrobot_serve_malformed", "payloads that are not requests", labels=["model"])
        malformed.add_metric([model], statistics["malformed"])
        batches = CounterMetricFamily("ibrobot_serve_batches", "by requests in one run", labels=["model", "size"])
        for size, count in statistics["batches"].items():
            batches.add_metric([model, size], count)
        # Totals over all robots, since the service forgets robots that are silent for long.
        together: _Rows = {(model,): statistics}
        each: _Rows = {(model, name[:_LABEL_SIZE]): counts for name, counts in statistics["robots"].items()}
        return [
            _gauge("uptime_seconds", "time since the start", model, statistics["uptime_s"]),
            _gauge("waiting", "robots with waiting requests", model, statistics["waiting"]),
            _gauge("pace_seconds", "time between the requests of a robot", model, statistics["pace_ms"] / 1e3),
            malformed,
            batches,
            *_answers("ibrobot_serve", ("model",), together),
            *_answers("ibrobot_serve_robot", ("model", "robot"), each),
        ]


def _gauge(name: str, about: str, model: str, value: float) -> Metric:
    family = GaugeMetricFamily(f"ibrobot_serve_{name}", about, labels=["model"])
    family.add_metric([model], value)
    return family


def _answers(prefix: str, labels: tuple[str, ...], rows: _Rows) -> Iterable[Metric]:
    """Requests and their latencies, for each row's values of the labels."""
    for name in _COUNTS:
        counter = CounterMetricFamily(f"{prefix}_{name}", "requests, by result", labels=labels)
        for values, counts in rows.items():
            counter.add_metric(values, counts[name])
        yield counter
    for name in ("latency_p50", "latency_p99"):
        gauge = GaugeMetricFamily(f"{prefix}_{name}_seconds", "of the newest thousand requests", labels=labels)
        for values, counts in rows.items():
            gauge.add_metric(values, counts[f"{name}_ms"] / 1e3)
        yield gauge

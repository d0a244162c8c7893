"""What a server of a model counts, for Prometheus, and whether it is well."""

from __future__ import annotations

from ibrobot_core.api import Metrics, MetricsProbes
from ibrobot_serve.service import InferenceService

_COUNTS = ("requests", "answered", "failed", "expired")
_TIMES = ("latency_p50_ms", "latency_p99_ms")


def probes(service: InferenceService) -> MetricsProbes:
    """What an HTTP port says of a service."""
    return MetricsProbes(
        lambda metrics: collect(service, metrics),
        lambda: "the model hangs" if service.state == "hangs" else "",
        lambda: "the server is stopping" if service.state == "draining" else "",
    )


def collect(service: InferenceService, metrics: Metrics) -> None:
    """Add all numbers of a service."""
    statistics = service.statistics()
    model = {"model": statistics["model"]}
    for name, about in (
        ("uptime_s", ""),
        ("waiting", "robots whose requests wait"),
        ("pace_ms", "time that robots are asked to leave between requests; 0: any"),
    ):
        metrics.add(f"serve_{name}", statistics[name], model, about=about)
    metrics.add("serve_malformed", statistics["malformed"], model, counter=True, about="payloads that are no request")
    for size, count in statistics["batches"].items():
        metrics.add("serve_batches", count, {**model, "size": size}, counter=True, about="by requests in one run")
    # All robots together, since a robot that was not heard of for long is forgotten.
    robots = [("serve_robot", {**model, "robot": name}, counts) for name, counts in statistics["robots"].items()]
    for prefix, labels, counts in [("serve", model, statistics), *robots]:
        for name in _COUNTS:
            metrics.add(f"{prefix}_{name}", counts[name], labels, counter=True)
        for name in _TIMES:
            metrics.add(f"{prefix}_{name}", counts[name], labels, about="of the newest thousand requests")

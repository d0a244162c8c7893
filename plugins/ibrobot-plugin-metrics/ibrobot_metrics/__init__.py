"""The plugin's hooks: section `metrics`."""

from __future__ import annotations

from collections.abc import Iterable

from ibrobot_core.api import Late, hookimpl
from ibrobot_core.app import SectionDescriptor
from ibrobot_metrics.options import MetricsOptions


@hookimpl
def ibrobot_sections() -> Iterable[SectionDescriptor]:
    """What is on `/diagnostics`, for Prometheus."""
    yield SectionDescriptor(
        type="metrics",
        options=MetricsOptions,
        make=Late("ibrobot_metrics.component:MetricsPort"),
        summary="counts in Prometheus' text format, over HTTP on this machine",
    )

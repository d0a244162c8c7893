"""The plugin's hooks: section `metrics`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from ibrobot_core.api import hookimpl
from ibrobot_core.app import SectionDescriptor
from ibrobot_metrics.options import MetricsOptions

if TYPE_CHECKING:
    from ibrobot_core.app import Component, RunView


def _port(options: MetricsOptions, session: RunView) -> Component:
    from ibrobot_metrics.component import MetricsPort

    return MetricsPort(options, session)


@hookimpl
def ibrobot_sections() -> Iterable[SectionDescriptor]:
    """What is on `/diagnostics`, for Prometheus."""
    yield SectionDescriptor(
        type="metrics",
        options=MetricsOptions,
        make=_port,
        summary="counts in Prometheus' text format, over HTTP on this machine",
    )

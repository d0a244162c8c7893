"""The hooks of the package: the kinds of pools and of reports."""

from __future__ import annotations

from collections.abc import Iterable

from ibrobot_core.api import hookimpl
from ibrobot_core.app import Kind
from ibrobot_provenance.jobs import PoolDescriptor
from ibrobot_provenance.reports import ReportDescriptor


@hookimpl
def ibrobot_kinds() -> Iterable[Kind]:
    """Pools, where jobs run, and reports on folders with results."""
    yield Kind("pool", "ibrobot_pools", PoolDescriptor)
    yield Kind("report", "ibrobot_reports", ReportDescriptor)

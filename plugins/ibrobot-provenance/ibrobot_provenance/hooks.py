"""The hooks of the package: the kinds of pools, of reports and of dataset writers."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from ibrobot_core.api import Descriptor, Late, hookimpl
from ibrobot_core.app import Kind
from ibrobot_provenance.datasets import DatasetDescriptor
from ibrobot_provenance.jobs import PoolDescriptor
from ibrobot_provenance.reports import ReportDescriptor


@hookimpl
def ibrobot_kinds() -> Iterable[Kind]:
    """Pools, where jobs run, reports on folders with results, and dataset writers."""
    yield Kind("pool", "ibrobot_pools", PoolDescriptor)
    yield Kind("dataset", "ibrobot_datasets", DatasetDescriptor)
    yield Kind("report", "ibrobot_reports", ReportDescriptor)


@hookimpl(optionalhook=True)
def ibrobot_samples() -> Iterable[Descriptor[Any]]:
    """What `ibrobot plugins new` begins with."""
    fakes = "ibrobot_provenance.fakes"
    yield Descriptor("pool", Late(f"{fakes}:FakePool"), "a pool with a process for each job")
    yield Descriptor("dataset", Late(f"{fakes}:FakeDataset"), "a writer of datasets as NumPy's files")
    yield Descriptor("report", Late(f"{fakes}:fake_report"), "a report on folders with one file")

"""The hooks of the package: the kind of pools."""

from __future__ import annotations

from collections.abc import Iterable

from ibrobot_core.api import hookimpl
from ibrobot_core.app import Kind
from ibrobot_provenance.jobs import PoolDescriptor


@hookimpl
def ibrobot_kinds() -> Iterable[Kind]:
    """Pools, where jobs run."""
    yield Kind("pool", "ibrobot_pools", PoolDescriptor)

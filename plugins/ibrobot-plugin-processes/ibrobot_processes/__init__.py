"""The plugin's hook: the pool `processes`, where jobs run by default."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from ibrobot_provenance.jobs import PoolDescriptor

from ibrobot_core.api import hookimpl
from ibrobot_core.app import RequestError

if TYPE_CHECKING:
    from ibrobot_provenance.jobs import Pool


def _make(address: str, jobs: int | None) -> Pool:
    from ibrobot_processes.pool import ProcessPool

    if address:
        raise RequestError(f"processes://{address}: processes run on this machine, and have no address")
    return ProcessPool(jobs)


@hookimpl
def ibrobot_pools() -> Iterable[PoolDescriptor]:
    """The pool `processes`."""
    yield PoolDescriptor(type="processes", make=_make, summary="in processes of this machine", default=True)

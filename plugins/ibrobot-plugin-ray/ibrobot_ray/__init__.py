"""The plugin's hook: the pool `ray`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from ibrobot_core.api import hookimpl
from ibrobot_core.app import PoolDescriptor

if TYPE_CHECKING:
    from ibrobot_core.app import Pool


def _make(address: str, jobs: int | None) -> Pool:
    from ibrobot_ray.pool import RayPool

    return RayPool(address, jobs)


@hookimpl
def ibrobot_pools() -> Iterable[PoolDescriptor]:
    """The pool `ray`."""
    yield PoolDescriptor(type="ray", make=_make, summary="on a Ray cluster: ray, or ray://HOST:10001")

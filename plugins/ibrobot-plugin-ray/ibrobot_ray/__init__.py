"""The plugin's hook: the pool `ray`."""

from __future__ import annotations

from collections.abc import Iterable

from ibrobot_provenance.jobs import PoolDescriptor

from ibrobot_core.api import Late, hookimpl


@hookimpl
def ibrobot_pools() -> Iterable[PoolDescriptor]:
    """The pool `ray`."""
    yield PoolDescriptor(
        type="ray", make=Late("ibrobot_ray.pool:RayPool"), summary="on a Ray cluster: ray, or ray://HOST:10001"
    )

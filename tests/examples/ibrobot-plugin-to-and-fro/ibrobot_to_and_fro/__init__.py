"""The cause `to_and_fro`: the hook by which ibrobot discovers it."""

from __future__ import annotations

from collections.abc import Iterable

from ibrobot_diagnose.cause import CauseDescriptor

from ibrobot_core.api import Late, hookimpl


@hookimpl
def ibrobot_causes() -> Iterable[CauseDescriptor]:
    """The cause `to_and_fro`."""
    yield CauseDescriptor(
        "to_and_fro",
        make=Late("ibrobot_to_and_fro.cause:ToAndFro"),
        summary="a joint is commanded to and fro",
    )

"""A plugin whose hook raises."""

from __future__ import annotations

from ibrobot_core import hookimpl


@hookimpl
def ibrobot_sensors():
    raise RuntimeError("no driver")

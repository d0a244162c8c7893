"""A plugin with a hook that does not exist."""

from __future__ import annotations

from ibrobot_core import hookimpl


@hookimpl
def ibrobot_hardwear():
    return []

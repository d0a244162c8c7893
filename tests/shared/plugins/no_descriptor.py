"""A plugin that offers something other than a descriptor."""

from __future__ import annotations

from ibrobot_core import hookimpl


@hookimpl
def ibrobot_policies():
    return ["act"]

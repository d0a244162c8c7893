"""A plugin whose hook takes an argument that the hook does not have."""

from __future__ import annotations

from ibrobot_core import hookimpl


@hookimpl
def ibrobot_mode_changed(moed):
    pass

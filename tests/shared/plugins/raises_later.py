"""A plugin whose checks and events raise."""

from __future__ import annotations

from ibrobot_core import hookimpl


@hookimpl
def ibrobot_doctor():
    raise OSError("no bus")


@hookimpl
def ibrobot_mode_changed():
    raise ValueError("not now")

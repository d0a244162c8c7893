"""Errors of recording and conversion."""

from __future__ import annotations

from ibrobot_core.api import RecorderError


class DiskFull(RecorderError):
    """The disk has less free space than an episode needs."""

    from_input = False

"""A check of `ibrobot doctor` that fails."""

from __future__ import annotations

from ibrobot_core import hookimpl
from ibrobot_core.descriptors import Check


@hookimpl
def ibrobot_doctor():
    yield Check("GL", False, "no context", "apt install libegl1")

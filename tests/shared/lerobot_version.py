"""What versions of LeRobot differ in, for the tests that run with each of them."""

from __future__ import annotations

from importlib.metadata import version

import pytest
from packaging.version import Version

LEROBOT = Version(version("lerobot"))
"""The installed one."""


def since(first: str, why: str) -> pytest.MarkDecorator:
    """Skip a test with LeRobot before `first`; `why` says what that does otherwise."""
    return pytest.mark.skipif(Version(first) > LEROBOT, reason=f"LeRobot before {first} {why}")

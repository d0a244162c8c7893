"""Checks that the packages for planning around obstacles, and their system library, are installed."""

from __future__ import annotations

import ctypes
import sys
from importlib.util import find_spec

from ibrobot_core.api import MissingDependency, how_to_install


def find_engines() -> None:
    """Check that kinematics and collision checks are installed.

    Raises:
        MissingDependency: with the command that installs what is missing.
    """
    missing = [name for name in ("pinocchio", "coal", "mujoco") if find_spec(name) is None]
    if missing:
        raise MissingDependency(
            f"planning around obstacles needs the Python package {missing[0]}, which is not installed",
            remedy=how_to_install("ibrobot-plugin-planning[obstacles]"),
        )
    if sys.platform == "linux":
        try:
            ctypes.CDLL("libgomp.so.1")  # Pinocchio's wheel does not bring it
        except OSError:
            message = "planning around obstacles needs the system library libgomp.so.1, and so does the guard"
            raise MissingDependency(message, apt=["libgomp1"]) from None

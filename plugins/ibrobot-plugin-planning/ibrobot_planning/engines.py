"""Whether the packages for planning around obstacles are installed."""

from __future__ import annotations

from importlib.util import find_spec

from ibrobot_core.api import MissingDependency


def find_engines() -> None:
    """Check that kinematics and collision checks are installed.

    Raises:
        MissingDependency: with the command that installs them.
    """
    missing = [name for name in ("pinocchio", "coal", "mujoco", "ibrobot_kinematics") if find_spec(name) is None]
    if missing:
        raise MissingDependency(
            f"planning around obstacles needs the Python package {missing[0]}, which is not installed",
            remedy="pip install 'ibrobot-plugin-planning[obstacles]'",
        )

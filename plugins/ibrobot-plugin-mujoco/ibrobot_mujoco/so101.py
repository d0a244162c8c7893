"""The SO-101 follower as a `Robot`, for benchmarks, tests and scripts that have no robot YAML."""

from __future__ import annotations

from functools import cache

from ibrobot_core.api import Robot
from ibrobot_core.app import installed_plugins, load_config


@cache
def so101() -> Robot:
    """The robot of `configs/so101.yaml`."""
    return load_config(installed_plugins().shipped_configs()["so101"], sim=True).robot

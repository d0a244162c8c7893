"""The SO-101 follower as a `Robot`, for benchmarks, tests and scripts that have no robot YAML."""

from __future__ import annotations

from functools import cache

from ibrobot_core.api import Robot
from ibrobot_core.app import installed_plugins, load_config, shipped_configs


@cache
def so101() -> Robot:
    """The robot of `configs/so101.yaml`."""
    return load_config(shipped_configs(installed_plugins())["so101"], sim=True).robot

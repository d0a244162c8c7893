"""Makes robots."""

from typing import Any


def make_robot_from_config(config: Any) -> Any:
    """The robot of a config."""
    return config.device(config)

"""Makes cameras."""

from typing import Any


def make_cameras_from_configs(configs: dict[str, Any]) -> dict[str, Any]:
    """The cameras of configs."""
    return {name: config.device(config) for name, config in configs.items()}

"""Makes teleoperators."""

from typing import Any


def make_teleoperator_from_config(config: Any) -> Any:
    """The teleoperator of a config."""
    return config.device(config)

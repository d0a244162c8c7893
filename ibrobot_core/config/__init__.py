"""The robot YAML: schema, loading with errors that name file and line, overrides, JSON Schema."""

from ibrobot_core.config.load import find_config, from_document, load_config
from ibrobot_core.schema import RobotConfig

__all__ = ["RobotConfig", "find_config", "from_document", "load_config"]

"""Where the message types of plugins come from: discovery, which imports no messages, sets it for those who ask."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

source: Callable[[], Mapping[str, Any]] = dict
"""Returns ROS name -> `MessageDescriptor` of the installed plugins."""

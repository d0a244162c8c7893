"""Message types, actions and services by their ROS names, e.g. `sensor_msgs/msg/Image`."""

from __future__ import annotations

import importlib
from typing import Any

from rclpy.type_support import check_for_type_support


def find_type(name: str) -> Any:
    """The class of a type.

    Raises:
        LookupError: if it is not installed, or its libraries cannot be loaded.
    """
    package, kind, base = name.split("/")
    try:
        found = getattr(importlib.import_module(f"{package}.{kind}"), base)
        if kind == "msg":
            check_for_type_support(found)
    except (ImportError, AttributeError) as error:
        raise LookupError(f"this ROS has no {name}: {error}") from error
    return found

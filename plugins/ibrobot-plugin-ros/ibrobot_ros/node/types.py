"""Message types, actions and services by their ROS names, e.g. `sensor_msgs/msg/Image`."""

from __future__ import annotations

import importlib
from array import array
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from rclpy.type_support import check_for_type_support


def find_type(name: str) -> Any:
    """The class of a type.

    Raises:
        LookupError: if it is not installed, or its libraries cannot be loaded.
    """
    package, kind, base = name.split("/")
    try:
        loaded = getattr(importlib.import_module(f"{package}.{kind}"), base)
        if kind == "msg":
            check_for_type_support(loaded)
    except (ImportError, AttributeError) as error:
        raise LookupError(f"this ROS has no {name}: {error}") from error
    return loaded


def find_message(name: str, fields: Sequence[str]) -> Any:
    """The class of a message type whose serialised messages are passed on as they are.

    Raises:
        LookupError: as `find_type`, or if its fields are not the run's `fields`, in their order.
    """
    loaded = find_type(name)
    theirs = list(loaded.get_fields_and_field_types())
    if fields and theirs != list(fields):
        raise LookupError(f"{name} has other fields in this ROS: {', '.join(theirs)}")
    return loaded


def fill(message: Any, values: Mapping[str, Any]) -> Any:
    """Set the fields of a message that `values` has; returns the message. Others stay as they are.

    Raises:
        LookupError: for a value that does not fit its field.
    """
    for field, kind in message.get_fields_and_field_types().items():
        if field not in values:
            continue
        value = values[field]
        if isinstance(value, Mapping):
            fill(getattr(message, field), value)
            continue
        if value and isinstance(value, list) and isinstance(value[0], Mapping):
            item = find_type(kind.removeprefix("sequence<").partition("[")[0].rstrip(">").replace("/", "/msg/", 1))
            value = [fill(item(), each) for each in value]
        try:
            setattr(message, field, value)
        except AssertionError as error:
            raise LookupError(f"{type(message).__name__}.{field}: {error}") from error
    return message


def plain(value: Any) -> Any:
    """A message, or a field of one, as JSON says it."""
    if isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.ndarray | array):
        return value.tolist()
    if isinstance(value, list | tuple | bytes):
        return [plain(each) for each in value]
    return {field: plain(getattr(value, field)) for field in value.get_fields_and_field_types()}

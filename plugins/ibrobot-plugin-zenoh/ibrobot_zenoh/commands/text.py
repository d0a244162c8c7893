"""Converts messages to YAML text, and back."""

from __future__ import annotations

from typing import Any

import attrs
import numpy as np

from ibrobot_core.api import MESSAGE_TYPES, Message, NotSupported, did_you_mean
from ibrobot_core.app import dump_yaml, single_options

_SHOWN = 16
"""Number of array elements to show."""


def shown(message: Message, *, full: bool) -> str:
    """A message as YAML; long arrays are truncated unless `full`."""
    return dump_yaml(_plain(message, full))


def _plain(value: Any, full: bool) -> Any:
    if attrs.has(type(value)):
        return {field.name: _plain(getattr(value, field.name), full) for field in attrs.fields(type(value))}
    if isinstance(value, np.ndarray):
        if full or value.size <= _SHOWN:
            return value.tolist()
        return [*value.ravel()[:_SHOWN].tolist(), f"… {value.size - _SHOWN} more"]
    if isinstance(value, (list, tuple)):
        return [_plain(item, full) for item in value]
    return value


def message_from(type_name: str, text: str) -> Message:
    """Parse a message from YAML, e.g. `{data: true}`.

    Raises:
        NotSupported: if the type cannot be written in this way.
        ConfigError: with all errors in the text.
    """
    kind = MESSAGE_TYPES.get(type_name)
    if kind is None:
        hint = did_you_mean(type_name, list(MESSAGE_TYPES), "the types are")
        raise NotSupported(f"{type_name!r} is not a type that can be published{hint}")
    return single_options(kind, (), "MESSAGE", text=text)

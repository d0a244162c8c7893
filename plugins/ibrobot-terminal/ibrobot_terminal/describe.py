"""Descriptions of a section's keys and a plugin's options, for `ibrobot plugins show` and the reference pages."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any, get_args

import attrs

from ibrobot_core.app import default_of, fields, plain


@attrs.frozen
class KeyDescription:
    """The description of a key."""

    name: str
    type: str
    unit: str
    required: bool
    default: Any
    """The default as in YAML; `(required)` for a key without one."""
    allowed: str
    """Range or choices."""
    secret: bool
    help: str


def described(kind: type[Any]) -> Iterator[KeyDescription]:
    """The descriptions of a class's keys, in order."""
    for name, field in fields(kind).items():
        default = default_of(field)
        required = default is attrs.NOTHING
        yield KeyDescription(
            name=name,
            type=type_name(field.type),
            unit=field.metadata.get("unit", ""),
            required=required,
            default="(required)" if required else plain(default),
            allowed=_allowed(field),
            secret=bool(field.metadata.get("secret")),
            help=field.metadata.get("help", ""),
        )


def type_name(kind: Any) -> str:
    """A type annotation without module names."""
    text = kind.__name__ if isinstance(kind, type) and not get_args(kind) else str(kind)
    return re.sub(r"\w+\.(?=\w)", "", text)


def _allowed(field: attrs.Attribute[Any]) -> str:
    if field.metadata.get("secret"):
        return "secret: ${NAME}"
    if field.metadata.get("choices") is not None:
        return ", ".join(map(str, field.metadata["choices"])) + (", …" if field.metadata["open"] else "")
    signs = {"ge": "≥", "gt": ">", "le": "≤", "lt": "<"}
    bounds = [f"{sign} {field.metadata[name]}" for name, sign in signs.items() if field.metadata.get(name) is not None]
    return ", ".join(bounds)

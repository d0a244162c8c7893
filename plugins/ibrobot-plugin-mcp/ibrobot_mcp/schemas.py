"""JSON Schemas of requests, from the attrs classes that declare them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import UnionType
from typing import Any, Literal, TypeAliasType, Union, get_args, get_origin

import attrs

from ibrobot_core.app import Service, default_of, fields

_PLAIN: Mapping[Any, str] = {bool: "boolean", int: "integer", float: "number", str: "string", Path: "string"}
_BOUNDS = {"ge": "minimum", "gt": "exclusiveMinimum", "le": "maximum", "lt": "exclusiveMaximum"}
_DEEPEST = 6
"""Classes within one another that are described; what lies deeper may be anything."""


def request_schema(service: Service[Any, Any]) -> dict[str, Any]:
    """The schema of the requests to a service, an object."""
    return _object(service.request, 0)


def _object(kind: type[Any], depth: int) -> dict[str, Any]:
    known = fields(kind)
    required = [name for name, field in known.items() if default_of(field) is attrs.NOTHING]
    properties = {name: _field(field, depth) for name, field in known.items()}
    return {"type": "object", "properties": properties, "required": required, "additionalProperties": False}


def _field(field: attrs.Attribute[Any], depth: int) -> dict[str, Any]:
    metadata, schema = field.metadata, _type(field.type, depth)
    unit = f" [{metadata['unit']}]" if metadata.get("unit") else ""
    if text := metadata.get("help", ""):
        schema = {**schema, "description": f"{text[0].upper()}{text[1:]}{unit}."}
    if schema.get("type") in ("number", "integer"):
        schema |= {word: metadata[name] for name, word in _BOUNDS.items() if metadata.get(name) is not None}
    if metadata.get("choices") and not metadata["open"] and "enum" not in schema and schema.get("type") == "string":
        schema["enum"] = list(metadata["choices"])
    default = default_of(field)
    if isinstance(default, bool | int | float | str):
        schema["default"] = default
    return schema


def _type(kind: Any, depth: int) -> dict[str, Any]:  # noqa: PLR0911 - one for each kind of type
    if isinstance(kind, TypeAliasType):
        kind = kind.__value__
    if kind in _PLAIN:
        return {"type": _PLAIN[kind]}
    if kind is type(None):
        return {"type": "null"}
    origin = get_origin(kind) or kind
    if origin is Literal:
        return {"enum": list(get_args(kind))}
    if origin in (Union, UnionType):
        parts = [_type(each, depth) for each in get_args(kind)]
        return {"anyOf": [part for i, part in enumerate(parts) if part not in parts[:i]]}
    if origin in (dict, Mapping):
        return {"type": "object", "additionalProperties": _type((*get_args(kind), Any, Any)[1], depth)}
    if origin in (tuple, list, Sequence):
        items = [each for each in get_args(kind) if each is not Ellipsis]
        if len(items) > 1:
            return {"type": "array", "items": _type(items[0], depth), "minItems": len(items), "maxItems": len(items)}
        return {"type": "array", "items": _type(items[0], depth) if items else {}}
    if isinstance(kind, type) and attrs.has(kind) and depth < _DEEPEST:
        return _object(kind, depth + 1)
    return {}

"""JSON Schemas (draft 2020-12) of options classes, for editors of robot YAMLs and for tools of agents."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import UnionType
from typing import Any, Literal, TypeAliasType, Union, get_args, get_origin

import attrs

from ibrobot_core.app import default_of, fields, plain

Schema = dict[str, Any]

_SCALARS: Mapping[Any, Schema] = {
    bool: {"type": "boolean"},
    int: {"type": "integer"},
    float: {"type": "number"},
    str: {"type": "string"},
    Path: {"type": "string"},
    type(None): {"type": "null"},
}
_BOUNDS = {"ge": "minimum", "gt": "exclusiveMinimum", "le": "maximum", "lt": "exclusiveMaximum"}
_DEEPEST = 8
"""Classes within one another that are described; what lies deeper, as in a class that contains itself, is anything."""


class OptionSchemas:
    """Type annotations -> schemas."""

    def __init__(self) -> None:
        self._depth = 0

    def of_type(self, kind: Any) -> Schema:
        """The schema of a type annotation; for `Any`, `{}`, which allows everything."""
        if isinstance(kind, TypeAliasType):
            kind = kind.__value__
        if kind in _SCALARS:
            return dict(_SCALARS[kind])
        origin = get_origin(kind) or kind
        for origins, schema in (
            ((UnionType, Union), self.of_union),
            ((Literal,), lambda kind: {"enum": list(get_args(kind))}),
            ((tuple, list, Sequence), self._of_sequence),
            ((dict, Mapping), self.of_mapping),
        ):
            if origin in origins:
                return schema(kind)
        return self.of_class(kind) if isinstance(kind, type) and attrs.has(kind) else {}

    def of_class(self, kind: type[Any]) -> Schema:
        """The schema of an options class."""
        if self._depth == _DEEPEST:
            return {}
        self._depth += 1
        try:
            return self.of_fields(fields(kind))
        finally:
            self._depth -= 1

    def of_fields(self, known: Mapping[str, attrs.Attribute[Any]]) -> Schema:
        """The schema of a mapping with these keys."""
        return {
            "type": "object",
            "properties": {name: self._of_field(field) for name, field in known.items()},
            "required": [name for name, field in known.items() if field.default is attrs.NOTHING],
            "additionalProperties": False,
        }

    def of_union(self, kind: Any) -> Schema:
        """The schema of what is one of several types."""
        members = [self.of_type(member) for member in get_args(kind)]
        return {"anyOf": [member for i, member in enumerate(members) if member not in members[:i]]}

    def of_mapping(self, kind: Any) -> Schema:
        """The schema of a mapping with any keys."""
        _, item = get_args(kind) or (str, Any)
        return {"type": "object", "additionalProperties": self.of_type(item)}

    def _of_sequence(self, kind: Any) -> Schema:
        args = [arg for arg in get_args(kind) if arg is not Ellipsis] or [Any]
        items = [self.of_type(arg) for arg in args]
        if len(items) == 1:
            return {"type": "array", "items": items[0]}
        if all(each == items[0] for each in items):
            return {"type": "array", "items": items[0], "minItems": len(items), "maxItems": len(items)}
        return {"type": "array", "prefixItems": items, "items": False, "minItems": len(items)}

    def _of_field(self, field: attrs.Attribute[Any]) -> Schema:
        schema, metadata = self.of_type(field.type), field.metadata
        limits: Schema = {word: metadata[name] for name, word in _BOUNDS.items() if metadata.get(name) is not None}
        if metadata.get("choices") is not None and not metadata.get("open"):
            limits["enum"] = list(metadata["choices"])
        for variant in schema.get("anyOf", [schema]):
            if variant != _SCALARS[type(None)]:
                item = variant.get("items")  # of a sequence, each item is limited
                (item if isinstance(item, dict) else variant).update(limits)
        if metadata.get("secret"):
            schema["writeOnly"] = True
        unit = f" [{metadata['unit']}]" if metadata.get("unit") else ""
        if description := f"{metadata.get('help', '')}{unit}".strip():
            schema["description"] = description
        default = default_of(field)
        if default not in (attrs.NOTHING, None):
            schema["default"] = plain(default)
        return schema

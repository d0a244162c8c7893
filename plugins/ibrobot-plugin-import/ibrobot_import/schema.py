"""`ibrobot config schema`: a JSON Schema (draft 2020-12) of the robot YAML for editors, with the plugins' options."""

from __future__ import annotations

import json
import types
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin

import attrs

from ibrobot_core.app import (
    SECTIONS,
    ComponentConfig,
    Registry,
    component_of,
    default_of,
    echo,
    fields,
    installed_plugins,
    plain,
)

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


@attrs.frozen
class PrintSchema:
    """Print a JSON Schema of robot YAMLs, for editors.

    It has the options of every installed plugin.
    """

    def __call__(self) -> None:
        echo(json.dumps(json_schema(installed_plugins()), indent=2))


def json_schema(registry: Registry) -> Schema:
    """The schema of the whole file."""
    schemas = _Schemas(registry)
    schema = schemas.of_fields(SECTIONS)
    for name in registry.types("section"):
        section = registry.find("section", name)
        schema["properties"][name] = {**schemas.of_fields(fields(section.options)), "description": section.summary}
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "ibrobot robot YAML", **schema}


@attrs.frozen
class _Schemas:
    """Type annotations -> schemas."""

    registry: Registry

    def of_type(self, kind: Any) -> Schema:
        """The schema of a type annotation; for `Any`, `{}`, which allows everything."""
        if kind in _SCALARS:
            return dict(_SCALARS[kind])
        origin = get_origin(kind) or kind
        for origins, schema in (
            ((types.UnionType, Union), self._of_union),
            ((Literal,), lambda kind: {"enum": list(get_args(kind))}),
            ((tuple, list, Sequence), self._of_sequence),
            ((dict, Mapping), self._of_mapping),
        ):
            if origin in origins:
                return schema(kind)
        if isinstance(kind, type) and issubclass(kind, ComponentConfig):
            return self._of_component(kind)
        return self.of_fields(fields(kind)) if attrs.has(kind) else {}

    def of_fields(self, known: Mapping[str, attrs.Attribute[Any]]) -> Schema:
        """The schema of a mapping with these keys."""
        return {
            "type": "object",
            "properties": {name: self._of_field(field) for name, field in known.items()},
            "required": [name for name, field in known.items() if field.default is attrs.NOTHING],
            "additionalProperties": False,
        }

    def _of_union(self, kind: Any) -> Schema:
        if (component := component_of(kind)) is not None:  # without null, editors mark errors in it more precisely
            return self._of_component(component)
        return {"anyOf": [self.of_type(member) for member in get_args(kind)]}

    def _of_sequence(self, kind: Any) -> Schema:
        args = [arg for arg in get_args(kind) if arg is not Ellipsis] or [Any]
        if len(args) == 1:
            return {"type": "array", "items": self.of_type(args[0])}
        items = [self.of_type(arg) for arg in args]
        return {"type": "array", "prefixItems": items, "items": False, "minItems": len(args)}

    def _of_mapping(self, kind: Any) -> Schema:
        _, item = get_args(kind) or (str, Any)
        one = self.of_type(item)
        several = {"type": "object", "additionalProperties": one}
        if (component := component_of(item)) is not None and component.may_be_alone:
            return {"if": {"required": ["type"]}, "then": one, "else": several}
        return several

    def _of_component(self, kind: type[ComponentConfig]) -> Schema:
        """The schema of a section with a `type`, which determines its further keys.

        Where a plugin defines the kind, the type may stand alone.
        """
        schema = self._of_typed(kind)
        if kind.plugin_kind not in self.registry.kinds:
            return schema
        return {"anyOf": [{"type": "string", "enum": schema["properties"][kind.type_key()]["enum"]}, schema]}

    def _of_typed(self, kind: type[ComponentConfig]) -> Schema:
        offered = [descriptor for descriptor in self.registry.of_kind(kind.plugin_kind) if descriptor.fits(kind)]
        own, key = self.of_fields(fields(kind)), kind.type_key()
        own["properties"][key]["enum"] = [descriptor.type for descriptor in offered]
        default = own["properties"][key].get("default")
        branches = [
            {
                "if": {
                    "properties": {key: {"const": descriptor.type}},
                    "required": [key] if descriptor.type != default else [],
                },
                "then": {
                    **self.of_fields({**fields(descriptor.options), **fields(kind)}),
                    "description": descriptor.summary,
                },
            }
            for descriptor in offered
        ]
        del own["additionalProperties"]
        return {**own, "allOf": branches} if branches else own

    def _of_field(self, field: attrs.Attribute[Any]) -> Schema:
        schema, metadata = self.of_type(field.type), field.metadata
        limits: Schema = {word: metadata[name] for name, word in _BOUNDS.items() if metadata.get(name) is not None}
        if metadata.get("choices") is not None:
            limits["enum"] = list(metadata["choices"])
        for variant in schema.get("anyOf", [schema]):
            if variant != _SCALARS[type(None)]:
                variant.update(limits)
        if metadata.get("secret"):
            schema["writeOnly"] = True
        unit = f" [{metadata['unit']}]" if metadata.get("unit") else ""
        if description := f"{metadata.get('help', '')}{unit}".strip():
            schema["description"] = description
        default = default_of(field)
        if default not in (attrs.NOTHING, None):
            schema["default"] = plain(default)
        return schema

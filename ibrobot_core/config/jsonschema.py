"""A JSON Schema (draft 2020-12) of the robot YAML for editors, with the options of every installed plugin."""

from __future__ import annotations

import enum
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, get_args

import attrs

from ibrobot_core.config.convert import fields, is_literal, is_mapping, is_sequence, is_union
from ibrobot_core.config.keys import (
    ComponentKeys,
    ExecutorKeys,
    HardwareKeys,
    ModeKeys,
    ModelKeys,
    PeripheralKeys,
    RecordingKeys,
    Sections,
    SimulationKeys,
    TransportKeys,
)
from ibrobot_core.config.show import plain
from ibrobot_core.descriptors import HardwareDescriptor
from ibrobot_core.plugins import Registry

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


def _of_union(kind: Any) -> Schema:
    return {"anyOf": [_of_type(member) for member in get_args(kind)]}


def _of_sequence(kind: Any) -> Schema:
    args = [arg for arg in get_args(kind) if arg is not Ellipsis] or [Any]
    if len(args) == 1:
        return {"type": "array", "items": _of_type(args[0])}
    return {"type": "array", "prefixItems": [_of_type(arg) for arg in args], "items": False, "minItems": len(args)}


def _of_mapping(kind: Any) -> Schema:
    _, item = get_args(kind) or (str, Any)
    return {"type": "object", "additionalProperties": _of_type(item)}


def _of_type(kind: Any) -> Schema:
    """The schema of a type annotation; `{}`, which allows everything, for `Any`."""
    shapes: tuple[tuple[Callable[[Any], bool], Callable[[Any], Schema]], ...] = (
        (lambda k: k in _SCALARS, lambda k: dict(_SCALARS[k])),
        (is_union, _of_union),
        (is_literal, lambda k: {"enum": list(get_args(k))}),
        (is_sequence, _of_sequence),
        (is_mapping, _of_mapping),
        (lambda k: isinstance(k, type) and issubclass(k, enum.Enum), lambda k: {"enum": [m.value for m in k]}),
        (attrs.has, _of_class),
    )
    return next((build(kind) for fits, build in shapes if fits(kind)), {})


def _of_field(field: attrs.Attribute[Any]) -> Schema:
    schema = _of_type(field.type)
    limits: Schema = {
        word: field.metadata[name] for name, word in _BOUNDS.items() if field.metadata.get(name) is not None
    }
    if field.metadata.get("secret"):
        schema["writeOnly"] = True
    if field.metadata.get("choices") is not None:
        limits["enum"] = list(field.metadata["choices"])
    variants = [variant for variant in schema.get("anyOf", [schema]) if variant != _SCALARS[type(None)]]
    for variant in variants:
        variant.update(limits)
    unit = f" [{field.metadata['unit']}]" if field.metadata.get("unit") else ""
    if field.metadata.get("help") or unit:
        schema["description"] = f"{field.metadata.get('help', '')}{unit}".strip()
    default = default_of(field)
    if default not in (attrs.NOTHING, None):
        schema["default"] = plain(default)
    return schema


def default_of(field: attrs.Attribute[Any]) -> Any:
    """A field's default, made where it is a factory; `attrs.NOTHING` where it is required."""
    default: Any = field.default
    return default.factory() if isinstance(default, attrs.Factory) else default  # type: ignore[arg-type]


def _of_class(*kinds: type) -> Schema:
    known: dict[str, attrs.Attribute[Any]] = {}
    for kind in reversed(kinds):
        known |= fields(kind)
    return {
        "type": "object",
        "properties": {name: _of_field(field) for name, field in known.items()},
        "required": [name for name, field in known.items() if field.default is attrs.NOTHING],
        "additionalProperties": False,
    }


def _component(registry: Registry, kind: str, keys: type, types: list[str] | None = None) -> Schema:
    """A section with a `type`: which further keys it takes follows from it."""
    offered = registry.types(kind) if types is None else types
    own = _of_class(keys)
    own["properties"]["type"]["enum"] = offered
    branches = []
    for type_ in offered:
        descriptor = registry.find(kind, type_)
        then = _of_class(keys, descriptor.options)
        then["description"] = descriptor.summary
        branches.append({"if": {"properties": {"type": {"const": type_}}, "required": ["type"]}, "then": then})
    schema: Schema = {"type": "object", "properties": own["properties"], "required": own["required"]}
    return {**schema, "allOf": branches} if branches else schema


def _named(item: Schema) -> Schema:
    return {"type": "object", "additionalProperties": item}


def json_schema(registry: Registry) -> Schema:
    """The schema of the whole file."""
    schema = _of_class(Sections)
    simulated = [
        entry.descriptor.type
        for entry in registry.entries.values()
        if isinstance(entry.descriptor, HardwareDescriptor) and entry.descriptor.simulated
    ]
    real = [type_ for type_ in registry.types("hardware") if type_ not in simulated]
    hardware = _component(registry, "hardware", HardwareKeys, real)
    mode = _of_class(ModeKeys)
    mode["properties"]["planner"] = _component(registry, "planner", ComponentKeys)
    several = {"type": "object", "additionalProperties": hardware}
    sections: dict[str, Schema] = {
        "hardware": {"if": {"required": ["type"]}, "then": hardware, "else": several},
        "simulation": _component(registry, "hardware", SimulationKeys, sorted(simulated)),
        "peripherals": {"type": "array", "items": _component(registry, "sensor", PeripheralKeys)},
        "executors": _named(_component(registry, "executor", ExecutorKeys)),
        "models": _named(_component(registry, "policy", ModelKeys)),
        "control_modes": _named(mode),
        "teleoperation": _named(_component(registry, "teleop", ComponentKeys)),
        "recording": _component(registry, "recorder", RecordingKeys),
        "transport": _component(registry, "transport", TransportKeys),
        "viewer": _component(registry, "viewer", ComponentKeys),
    }
    for name, section in sections.items():
        description = schema["properties"][name]["description"]
        schema["properties"][name] = {"description": description, **section}
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "ibrobot robot YAML", **schema}

"""Plain values -> attrs classes, strictly: every fault is collected with its key, and no scalar changes its type."""

from __future__ import annotations

import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from collections.abc import Mapping as AbstractMapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin

import attrs
from cattrs import Converter

from ibrobot_core.config.expand import resolve_path
from ibrobot_core.config.yaml_nodes import Key
from ibrobot_core.options import hint

_SHOWN = 200
"""Characters of a value that a message shows."""
_YAML_1_1_BOOLS = {"on", "off", "yes", "no", "y", "n", "true", "false"}


def said(error: Exception) -> str:
    """An error's message; attrs' own validators put more than it into their errors."""
    return str(error.args[0]) if error.args else str(error)


@attrs.define(slots=False)
class Faults(ValueError):
    """What is wrong with a value: keys below it, each with a message."""

    found: list[tuple[Key, str]] = attrs.field(factory=list)

    def add(self, key: Key, message: str) -> None:
        """Note one fault."""
        self.found.append((key, message))

    @contextmanager
    def at(self, part: str | int) -> Iterator[None]:
        """Note the faults raised within as those of the item `part`."""
        try:
            yield
        except Faults as inner:
            self.found += [((part, *key), message) for key, message in inner.found]
        except (ValueError, TypeError) as error:
            self.found.append(((part,), said(error)))

    def raise_any(self) -> None:
        """Raise this if anything was noted."""
        if self.found:
            raise self


def unknown_key(word: str, known: Sequence[str]) -> str:
    """The message for a key that is not there."""
    return f"unknown key{hint(word, known, 'known keys')}"


def shown(value: Any) -> str:
    """A value as a message shows it."""
    if value is None:
        return "nothing"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, Mapping):
        return "a mapping"
    if isinstance(value, list | tuple):
        return "a list"
    text = repr(value)
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}… ({len(text)} characters)"


def _wrong(expected: str, value: Any, remark: str = "") -> ValueError:
    return ValueError(f"expected {expected}, got {shown(value)}{remark}")


def _bool(value: Any, _: Any) -> bool:
    if isinstance(value, bool):
        return value
    remark = " (only true and false, unquoted, are truth values)" if str(value).lower() in _YAML_1_1_BOOLS else ""
    raise _wrong("true or false", value, remark)


def _int(value: Any, _: Any) -> int:
    if isinstance(value, int) and not isinstance(value, bool):
        return value
    raise _wrong("a whole number", value)


def _float(value: Any, _: Any) -> float:
    if isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    raise _wrong("a number", value)


def _str(value: Any, _: Any) -> str:
    if isinstance(value, str):
        return value
    is_number = isinstance(value, int | float)
    raise _wrong("text", value, f" (quote it: '{shown(value)}')" if is_number else "")


def is_sequence(kind: Any) -> bool:
    """Whether a type annotation says list, tuple or Sequence."""
    return (get_origin(kind) or kind) in (tuple, list, Sequence)


def is_mapping(kind: Any) -> bool:
    """Whether a type annotation says dict or Mapping."""
    return (get_origin(kind) or kind) in (dict, AbstractMapping)


def is_union(kind: Any) -> bool:
    """Whether a type annotation says `A | B`."""
    return get_origin(kind) in (Union, types.UnionType)


def is_literal(kind: Any) -> bool:
    """Whether a type annotation says `Literal[...]`."""
    return get_origin(kind) in (Literal,)


Hook = Callable[[Any, Any], Any]


def _sequence_hook(kind: Any, converter: Converter) -> Hook:
    args = get_args(kind) or (Any, ...)
    build = list if (get_origin(kind) or kind) is list else tuple
    any_length = build is list or len(args) == 1 or args[1] is Ellipsis

    def structure(value: Any, _: Any) -> Any:
        if not isinstance(value, list | tuple):
            raise _wrong("a list", value)
        if not any_length and len(value) != len(args):
            raise ValueError(f"expected a list of {len(args)} values, got {len(value)}")
        faults = Faults()
        items = []
        for i, item in enumerate(value):
            with faults.at(i):
                items.append(converter.structure(item, args[0] if any_length else args[i]))
        faults.raise_any()
        return build(items)

    return structure


def _mapping_hook(kind: Any, converter: Converter) -> Hook:
    _, item_kind = get_args(kind) or (str, Any)

    def structure(value: Any, _: Any) -> dict[str, Any]:
        if not isinstance(value, Mapping):
            raise _wrong("a mapping", value)
        faults = Faults()
        items = {}
        for name, item in value.items():
            with faults.at(name):
                items[name] = converter.structure(item, item_kind)
        faults.raise_any()
        return items

    return structure


def _union_hook(kind: Any, converter: Converter) -> Hook:
    members = [member for member in get_args(kind) if member is not type(None)]
    optional = len(members) < len(get_args(kind))

    def structure(value: Any, _: Any) -> Any:
        if value is None and optional:
            return None
        reasons = []
        for member in members:
            try:
                return converter.structure(value, member)
            except Faults:
                raise
            except ValueError as error:
                reasons.append(str(error))
        if len(reasons) == 1:
            raise ValueError(reasons[0])
        expected = [
            " or ".join(map(str, get_args(member)))
            if is_literal(member)
            else reason.removeprefix("expected ").partition(", got")[0]
            for member, reason in zip(members, reasons, strict=True)
        ]
        raise _wrong(" or ".join(expected), value)

    return structure


def _literal_hook(kind: Any, converter: Converter) -> Hook:
    choices = get_args(kind)

    def structure(value: Any, _: Any) -> Any:
        if value in choices:
            return value
        raise ValueError(f"{value!r} is not one of: {', '.join(str(c) for c in choices)}")

    return structure


def fields(kind: type) -> dict[str, attrs.Attribute[Any]]:
    """The keys that an options class takes, with resolved types."""
    attrs.resolve_types(kind)
    return {field.name: field for field in attrs.fields(kind) if field.init}


def _class_hook(kind: type, converter: Converter) -> Hook:
    known = fields(kind)

    def structure(value: Any, _: Any) -> Any:
        if not isinstance(value, Mapping):
            raise _wrong("a mapping", value)
        faults = Faults()
        for name in value:
            if name not in known:
                faults.add((name,), unknown_key(name, list(known)))
        arguments = structure_fields(known, value, converter, faults)
        faults.raise_any()
        return kind(**arguments)

    return structure


def structure_fields(
    known: Mapping[str, attrs.Attribute[Any]], value: Mapping[str, Any], converter: Converter, faults: Faults
) -> dict[str, Any]:
    """The fields that `value` gives, each converted and validated; what is wrong or missing goes to `faults`."""
    arguments: dict[str, Any] = {}
    for name, field in known.items():
        if name in value:
            with faults.at(name):
                arguments[name] = _structured(field, value[name], converter)
        elif field.default is attrs.NOTHING:
            faults.add((name,), "required key is missing")
    return arguments


def _structured(field: attrs.Attribute[Any], value: Any, converter: Converter) -> Any:
    try:
        item = converter.structure(value, field.type if field.type is not None else Any)
        if field.validator is not None:
            # Ahead of the constructor, so that every field is checked and the fault is found at its own key.
            field.validator(None, field, item)
    except (ValueError, TypeError):
        if not field.metadata.get("secret"):
            raise
        raise ValueError(
            "is not a valid value, which is not shown here; text must be quoted if it looks like a number"
        ) from None
    return item


def make_converter(base: Path) -> Converter:
    """A strict converter whose relative paths start at `base`."""
    converter = Converter(forbid_extra_keys=True, detailed_validation=True)
    converter.register_structure_hook(bool, _bool)
    converter.register_structure_hook(int, _int)
    converter.register_structure_hook(float, _float)
    converter.register_structure_hook(str, _str)
    converter.register_structure_hook(Path, lambda value, _: resolve_path(_str(value, str), base))
    converter.register_structure_hook_factory(is_sequence, _sequence_hook)
    converter.register_structure_hook_factory(is_mapping, _mapping_hook)
    converter.register_structure_hook_factory(is_union, _union_hook)
    converter.register_structure_hook_factory(is_literal, _literal_hook)
    converter.register_structure_hook_factory(attrs.has, _class_hook)
    return converter

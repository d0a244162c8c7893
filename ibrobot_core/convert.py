"""Plain values -> attrs classes, strictly: collects every fault with its key, and changes no scalar's type."""

from __future__ import annotations

import math
import types
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin

import attrs
import numpy as np
from numpy.typing import NDArray

from ibrobot_core.options import did_you_mean, fields

Key = tuple[str | int, ...]
"""The path of a value in a document: mapping keys and list indices from the root."""

MOST = 5
"""Largest number of faults in a message."""
_SHOWN = 200
"""Maximum length of a value in a message, in characters."""
_YAML_1_1_BOOLS = {"on", "off", "yes", "no", "y", "n", "true", "false"}
_SCALARS: Mapping[Any, tuple[type | tuple[type, ...], str]] = {
    bool: (bool, "true or false"),
    int: (int, "a whole number"),
    float: ((int, float), "a number"),
    str: (str, "text"),
}
"""Type -> accepted Python types, and their name in messages."""


def error_message(error: Exception) -> str:
    """The message of an error, without the further arguments in errors of attrs' validators."""
    return str(error.args[0]) if error.args else str(error)


@attrs.define(slots=False)
class Faults(ValueError):
    """The faults of a value: keys below it, each with a message."""

    found: list[tuple[Key, str]] = attrs.field(factory=list)

    def __str__(self) -> str:
        lines = [": ".join(filter(None, (".".join(map(str, key)), message))) for key, message in self.found[:MOST]]
        return "; ".join([*lines, *(["and more"] if len(self.found) > MOST else [])])

    def add(self, key: Key, message: str) -> None:
        """Add a fault."""
        self.found.append((key, message))

    @contextmanager
    def at(self, part: str | int) -> Iterator[None]:
        """Add the faults raised in the block as faults of the item `part`."""
        try:
            yield
        except (ValueError, TypeError) as error:
            self.take(part, error)

    def take(self, part: str | int, error: Exception) -> None:
        """Add the faults of an error as faults of the item `part`."""
        inner = error.found if isinstance(error, Faults) else [((), error_message(error))]
        self.found += [((part, *key), message) for key, message in inner]

    def raise_any(self) -> None:
        """Raise this error if it has faults."""
        if self.found:
            raise self


def unknown_key(word: str, known: Sequence[str]) -> str:
    """The message for an unknown key."""
    return f"unknown key{did_you_mean(word, known, 'known keys')}"


def shown(value: Any) -> str:
    """A value as text for messages."""
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


def _scalar(value: Any, kind: type) -> Any:
    taken, expected = _SCALARS[kind]
    fits = isinstance(value, taken) and (kind is bool or not isinstance(value, bool))
    if fits and kind is float:
        try:
            return float(value)
        except OverflowError:
            raise ValueError(f"{shown(value)} is too large") from None
    if fits:
        return value
    remark = ""
    if kind is bool and str(value).lower() in _YAML_1_1_BOOLS:
        remark = " (only true and false, unquoted, are truth values)"
    elif kind is str and isinstance(value, int | float):
        remark = f" (quote it: '{shown(value)}')"
    raise _wrong(expected, value, remark)


def is_sequence(kind: Any) -> bool:
    """Whether a type annotation is list, tuple or Sequence."""
    return (get_origin(kind) or kind) in (tuple, list, Sequence)


def is_mapping(kind: Any) -> bool:
    """Whether a type annotation is dict or Mapping."""
    return (get_origin(kind) or kind) in (dict, Mapping)


def is_union(kind: Any) -> bool:
    """Whether a type annotation is `A | B`."""
    return get_origin(kind) in (Union, types.UnionType)


def is_literal(kind: Any) -> bool:
    """Whether a type annotation is `Literal[...]`."""
    return get_origin(kind) is Literal


def is_array(kind: Any) -> bool:
    """Whether a type annotation is `NDArray[...]`."""
    return get_origin(kind) in (np.ndarray, NDArray)  # NDArray is an alias of its own in later versions of numpy


def no_files(text: str) -> Path:
    """Refuse to name a file, for values from outside.

    Raises:
        ValueError: always.
    """
    raise ValueError(f"{shown(text)}: no file can be named here")


@cache
def _method(kind: Any) -> str:
    """The method of `Converter` for types other than scalars; long lists have the same type many times."""
    methods: dict[Any, str] = {
        is_union: "_union", is_literal: "_literal", is_sequence: "_sequence", is_mapping: "_mapping",
        is_array: "_array", attrs.has: "_attrs",
    }  # fmt: skip
    for fits, name in methods.items():
        if fits(kind):
            return name
    raise TypeError(f"options of type {kind} are not supported")


@cache
def _dtype(kind: Any) -> np.dtype[Any]:
    scalar_type = get_args(kind)[-1]
    dtype: np.dtype[Any] = np.dtype(scalar_type if get_origin(kind) is not np.ndarray else get_args(scalar_type)[0])
    return dtype


@attrs.frozen
class Converter:
    """Converts plain values to the types of annotations."""

    files: Callable[[str], Path] = no_files
    """Finds the file that a text names; raises ValueError if there is none."""
    most: float = math.inf
    """Number of faults after which no more are looked for: each costs time."""

    def structure(self, value: Any, kind: Any) -> Any:
        """Convert `value` to a `kind`.

        Raises:
            Faults: for faults below the value.
            ValueError: for a fault of the value as a whole.
            TypeError: for an unsupported kind, which is a bug in an options class.
        """
        if kind is Any:
            return value
        if kind in _SCALARS:
            return _scalar(value, kind)
        if kind is Path:
            return self._path(_scalar(value, str))
        return getattr(self, _method(kind))(value, kind)

    def arguments(
        self, known: Mapping[str, attrs.Attribute[Any]], value: Mapping[str, Any], faults: Faults
    ) -> dict[str, Any]:
        """The fields in `value`, converted and validated; faults and missing keys are added to `faults`."""
        arguments: dict[str, Any] = {}
        for name, field in known.items():
            if name in value:
                try:
                    arguments[name] = self._field(field, value[name])
                except (ValueError, TypeError) as error:
                    faults.take(name, error)
            elif field.default is attrs.NOTHING:
                faults.add((name,), "required key is missing")
        return arguments

    def _path(self, text: str) -> Path:
        try:
            return self.files(text)
        except OSError as error:
            raise ValueError(f"{shown(text)}: {error.strerror}") from error

    def _field(self, field: attrs.Attribute[Any], value: Any) -> Any:
        try:
            item = self.structure(value, field.type if field.type is not None else Any)
            if field.validator is not None:
                # Validate before the constructor, so that every field is checked and each fault has its own key.
                field.validator(None, field, item)
        except (ValueError, TypeError):
            if not field.metadata.get("secret"):
                raise
            raise ValueError(
                "is not a valid value, which is not shown here; text must be quoted if it looks like a number"
            ) from None
        return item

    def _attrs(self, value: Any, kind: type) -> Any:
        if not isinstance(value, Mapping):
            raise _wrong("a mapping", value)
        known, faults = fields(kind), Faults()
        for name in (name for name in value if name not in known):
            faults.add((name,), unknown_key(name, list(known)))
            if len(faults.found) >= self.most:
                break
        arguments = self.arguments(known, value, faults)
        faults.raise_any()
        return kind(**arguments)

    def _sequence(self, value: Any, kind: Any) -> Any:
        if not isinstance(value, list | tuple):
            raise _wrong("a list", value)
        args = get_args(kind) or (Any, ...)
        build = list if (get_origin(kind) or kind) is list else tuple
        any_length = build is list or len(args) == 1 or args[1] is Ellipsis
        if not any_length and len(value) != len(args):
            raise ValueError(f"expected a list of {len(args)} values, got {len(value)}")
        return build(self._items((i, item, args[0] if any_length else args[i]) for i, item in enumerate(value)))

    def _mapping(self, value: Any, kind: Any) -> dict[str, Any]:
        if not isinstance(value, Mapping):
            raise _wrong("a mapping", value)
        _, item_kind = get_args(kind) or (str, Any)
        items = self._items((name, item, item_kind) for name, item in value.items())
        return dict(zip(value, items, strict=True))

    def _array(self, value: Any, kind: Any) -> NDArray[Any]:
        """A list of numbers as an array, shape (N,)."""
        if not isinstance(value, list | tuple):
            raise _wrong("a list of numbers", value)
        dtype = _dtype(kind)
        scalar = float if dtype.kind == "f" else int
        if set(map(type, value)) <= {scalar}:
            numbers = list(value)
        else:
            numbers = self._items((i, item, scalar) for i, item in enumerate(value))
        try:
            return np.array(numbers, dtype)
        except OverflowError:
            limits = np.iinfo(dtype)
            raise ValueError(f"expected whole numbers from {limits.min} to {limits.max}") from None

    def _items(self, items: Iterable[tuple[str | int, Any, Any]]) -> list[Any]:
        """Convert items, given as key, value and kind."""
        faults, values = Faults(), []
        for key, item, kind in items:
            try:
                values.append(self.structure(item, kind))
            except (ValueError, TypeError) as error:
                faults.take(key, error)
            if len(faults.found) >= self.most:
                break
        faults.raise_any()
        return values

    def _union(self, value: Any, kind: Any) -> Any:
        members = [member for member in get_args(kind) if member is not type(None)]
        if value is None and len(members) < len(get_args(kind)):
            return None
        if isinstance(value, Mapping) and (classes := [member for member in members if attrs.has(member)]):
            # The faults of the class that the keys are of.
            return self.structure(value, max(classes, key=lambda each: len(fields(each).keys() & value.keys())))
        reasons = []
        for member in members:
            try:
                return self.structure(value, member)
            except Faults:
                raise
            except ValueError as error:
                reasons.append(str(error))
        if len(reasons) == 1:
            raise ValueError(reasons[0] + " (null switches it off)" * (value is False))
        expected = [
            " or ".join(map(str, get_args(member)))
            if is_literal(member)
            else reason.removeprefix("expected ").partition(", got")[0]
            for member, reason in zip(members, reasons, strict=True)
        ]
        raise _wrong(" or ".join(dict.fromkeys(expected)), value)

    def _literal(self, value: Any, kind: Any) -> Any:
        choices = get_args(kind)
        if value in choices:
            return value
        raise ValueError(f"{shown(value)} is not one of: {', '.join(str(c) for c in choices)}")

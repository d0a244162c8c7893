"""Siblings of a document of JSON or YAML: each of its values is replaced, or lacking."""

from __future__ import annotations

import copy
import json
from collections.abc import Iterator
from typing import Any

HOSTILE: tuple[Any, ...] = (
    None, True, -1, 0, 1e308, 10**30, float("nan"), float("inf"), "", "a\n\x1b[2J<script>\u202e", "../../etc", [], {},
    [None], [[]], {"": 0}, "x" * 10_000,
)  # fmt: skip
"""What stands in place of a value."""
_MOST = 3
"""Elements of a list that are changed; the others are alike."""


def siblings(document: Any) -> Iterator[tuple[str, Any]]:
    """Where a document differs, and the document; each of its values in turn."""
    for path in _paths(document, ()):
        for replaced in HOSTILE:
            changed = copy.deepcopy(document)
            parent = _at(changed, path[:-1])
            parent[path[-1]] = copy.deepcopy(replaced)
            yield f"{'.'.join(map(str, path))} = {str(replaced)[:40]!r}", changed
        changed = copy.deepcopy(document)
        del _at(changed, path[:-1])[path[-1]]
        yield f"{'.'.join(map(str, path))} is lacking", changed


def texts(document: Any) -> Iterator[tuple[str, str]]:
    """The same as texts of JSON, and some that are none."""
    for where, each in siblings(document):
        yield where, json.dumps(each)
    whole = json.dumps(document)
    yield from (
        ("empty", ""),
        ("half", whole[: len(whole) // 2]),
        ("deep", "[" * 100_000),
        ("no object", "[]"),
        ("zeros", "\0" * 100),
    )


def _paths(value: Any, path: tuple[Any, ...]) -> Iterator[tuple[Any, ...]]:
    items = value.items() if isinstance(value, dict) else enumerate(value[:_MOST]) if isinstance(value, list) else ()
    for key, inner in items:
        yield (*path, key)
        yield from _paths(inner, (*path, key))


def _at(value: Any, path: tuple[Any, ...]) -> Any:
    for key in path:
        value = value[key]
    return value

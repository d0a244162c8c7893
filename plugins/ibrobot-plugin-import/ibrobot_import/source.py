"""The file to import: typed access to its values, and what became of each of them."""

from __future__ import annotations

import re
from collections.abc import Mapping
from enum import StrEnum
from typing import Any

import attrs

from ibrobot_core.app import Document

Key = tuple[str | int, ...]
_VARIABLE = re.compile(r"\$\((?:env|optenv)\s+(\w+)(?:\s+([^)]*))?\)")
_LENGTH = 60


class Fate(StrEnum):
    """Fate of a value: taken, changed or refused."""

    TAKEN = "taken"
    CHANGED = "changed"
    REFUSED = "refused"


@attrs.frozen
class Verdict:
    """Fate of one value of the file, and the reason."""

    line: int
    key: str
    fate: Fate
    reason: str = ""

    def __str__(self) -> str:
        return f"line {self.line}: {self.key}: {self.reason}"


@attrs.frozen
class From:
    """A value of the new file with its comment, and the line of the old one that it comes from; 0 for none."""

    value: Any
    comment: str
    line: int = 0


@attrs.frozen
class Titled(From):
    """A mapping or list in block style, with its comment beside its name."""


@attrs.define
class Source:
    """The file to import. Every value gets a verdict, so that none is dropped in silence."""

    document: Document
    _fates: dict[Key, tuple[Fate, str]] = attrs.field(factory=dict, init=False)

    @property
    def root(self) -> Node:
        """The whole file."""
        return Node(self, ())

    def mark(self, key: Key, fate: Fate, reason: str, *, keeps: bool = False) -> None:
        """Note what became of the values at or below `key`; `keeps` earlier verdicts."""
        if key and _is_plain_list(self.document.get(*key[:-1])):
            key = key[:-1]
        for leaf in _leaves(self.document.get(*key), key):
            if not keeps or leaf not in self._fates:
                self._fates[leaf] = (fate, reason)

    def verdicts(self, program: str) -> list[Verdict]:
        """The verdict of each value in the order of the lines; values without one are unknown to `program`."""
        unknown = (Fate.REFUSED, f"without a counterpart here; ibrobot does not know it as a key of {program}")
        verdicts = []
        for leaf in _leaves(self.document.root, ()):
            fate, reason = self._fates.get(leaf, unknown)
            verdicts.append(Verdict(self.document.place(leaf).line, self.document.dotted(leaf), fate, reason))
        return sorted(verdicts, key=lambda each: each.line)


@attrs.frozen
class Node:
    """A place in the file, which need not exist."""

    source: Source
    key: Key

    def __getitem__(self, name: str | int) -> Node:
        return Node(self.source, (*self.key, name))

    @property
    def value(self) -> Any:
        """Its plain value; None if it is not there."""
        return self.source.document.get(*self.key)

    @property
    def line(self) -> int:
        """Its line, or that of the block that contains it."""
        return self.source.document.place(self.key).line

    @property
    def origin(self) -> str:
        """Line and key, for comments."""
        return f"line {self.line}: {self.source.document.dotted(self.key)}"

    def items(self) -> list[tuple[str, Node]]:
        """The names and values of a mapping; empty if it is not there."""
        if self.value is None:
            return []
        if not isinstance(self.value, Mapping):
            self.fault("a mapping")
            return []
        return [(name, self[name]) for name in self.value]

    def each(self) -> list[Node]:
        """The items of a list; empty if it is not there."""
        if self.value is None:
            return []
        if not isinstance(self.value, list):
            self.fault("a list")
            return []
        return [self[i] for i in range(len(self.value))]

    def text(self, note: str = "") -> From | None:
        """Take a text; `$(env NAME)` becomes `${NAME}`."""
        value = self.value
        if isinstance(value, int) and not isinstance(value, bool):
            value = str(value)
        return self._take(value, isinstance(value, str), "a text", note)

    def number(self, note: str = "") -> From | None:
        """Take a number."""
        value = self.value
        return self._take(value, isinstance(value, int | float) and not isinstance(value, bool), "a number", note)

    def whole(self, note: str = "") -> From | None:
        """Take a whole number; 30.0 counts as one."""
        value = self.value
        if isinstance(value, float) and value.is_integer():
            value = int(value)
        return self._take(value, isinstance(value, int) and not isinstance(value, bool), "a whole number", note)

    def flag(self) -> bool | None:
        """Whether it is true; None if it is not there."""
        if self.value is not None and not isinstance(self.value, bool):
            self.fault("true or false")
            return None
        return self.value if self.value is None else bool(self.value)

    def texts(self) -> list[str]:
        """A list of texts, or numbers as texts, without a verdict; empty if it is not there."""
        values = [each.value for each in self.each()]
        if not all(isinstance(each, str | int) and not isinstance(each, bool) for each in values):
            self.fault("a list of names")
            return []
        return [str(each) for each in values]

    def numbers(self, count: int) -> list[float]:
        """A list of numbers, without a verdict; empty if it is not there, or has a fault."""
        values = [each.value for each in self.each()]
        right = all(isinstance(each, int | float) and not isinstance(each, bool) for each in values)
        if values and (len(values) != count or not right):
            self.fault(f"{count} numbers")
            return []
        return values

    def gives(self, value: Any, note: str = "") -> From:
        """A value of the new file that comes from here, without a verdict."""
        return From(value, f"{self.origin}; {note}" if note else self.origin, self.line)

    def titles(self, values: Mapping[str, Any]) -> Titled:
        """A block of the new file that comes from here."""
        return Titled(values, self.origin, self.line)

    def changed(self, value: Any, note: str) -> From:
        """Take it as another value."""
        self.source.mark(self.key, Fate.CHANGED, note)
        return self.gives(value, note)

    def taken(self, value: Any, note: str = "") -> From:
        """Take it as it is, perhaps in other words."""
        self.source.mark(self.key, Fate.TAKEN, note)
        return self.gives(value, note)

    def refuse(self, reason: str) -> None:
        """Note that it, or all below it without a verdict, has no counterpart."""
        self.source.mark(self.key, Fate.REFUSED, reason, keeps=True)

    def refuse_all(self, reasons: Mapping[str, str]) -> None:
        """Note that values below it have no counterpart: keys, with spaces between them -> why."""
        for keys, reason in reasons.items():
            for key in keys.split():
                self[key].refuse(reason)

    def drop(self, reason: str) -> None:
        """Note that it and all below it have no counterpart, whatever was taken of it before."""
        self.source.mark(self.key, Fate.REFUSED, reason)

    def fault(self, expected: str) -> None:
        """Report a value of the wrong type."""
        shown = repr(self.value)
        shown = shown if len(shown) <= _LENGTH else f"{shown[:_LENGTH]}…"
        self.source.document.add(self.key, f"expected {expected}, got {shown}")

    def wrong(self, message: str) -> None:
        """Report a wrong value."""
        self.source.document.add(self.key, message)

    def _take(self, value: Any, right: bool, expected: str, note: str) -> From | None:
        if value is None:
            return None
        if not right:
            self.fault(expected)
            return None
        if isinstance(value, str) and "${" in value:
            self.wrong("ibrobot would read ${…} as a variable of the environment; write out what it stands for")
            return None
        if isinstance(value, str) and _VARIABLE.search(value):
            expanded = _VARIABLE.sub(lambda m: f"${{{m[1]}{':' + m[2] if m[2] else ''}}}", value)
            return self.changed(expanded, note or "variables are written ${NAME}")
        return self.changed(value, note) if note else self.taken(value)


def plain_name(name: str) -> str:
    """A name with the characters that ibrobot allows."""
    return re.sub(r"[^A-Za-z0-9_-]", "_", name)


def _is_plain_list(value: Any) -> bool:
    return isinstance(value, list) and not any(isinstance(each, Mapping | list) for each in value)


def _leaves(value: Any, key: Key) -> list[Key]:
    """The keys of the values below `key`; a list of plain values is one."""
    if isinstance(value, Mapping) and value:
        return [leaf for name, each in value.items() for leaf in _leaves(each, (*key, name))]
    if isinstance(value, list) and not _is_plain_list(value):
        return [leaf for i, each in enumerate(value) for leaf in _leaves(each, (*key, i))]
    return [key] if key else []

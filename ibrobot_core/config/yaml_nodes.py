"""YAML text -> plain values and the place of every key, with YAML 1.2 scalars and without repeated keys."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Any

import attrs
import yaml
from yaml.composer import Composer
from yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode
from yaml.resolver import BaseResolver

from ibrobot_core.config.expand import expand
from ibrobot_core.convert import Key
from ibrobot_core.errors import ConfigError, Problem
from ibrobot_core.options import did_you_mean
from ibrobot_core.safe_output import redacted

_DEFAULT_TAGS = (BaseResolver.DEFAULT_SCALAR_TAG, BaseResolver.DEFAULT_SEQUENCE_TAG, BaseResolver.DEFAULT_MAPPING_TAG)
_BOOLS = {"true": True, "True": True, "TRUE": True, "false": False, "False": False, "FALSE": False}
_NULLS = {"", "~", "null", "Null", "NULL"}
_INT = re.compile(r"[-+]?[0-9]+")
_BASED = re.compile(r"0o[0-7]+|0x[0-9a-fA-F]+")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
_SPECIAL = re.compile(r"([-+]?)\.(inf|Inf|INF)|\.(nan|NaN|NAN)")
_READ_OTHERWISE = re.compile("[\t?!\ufeff\ud800-\udfff]")
"""What libyaml takes where PyYAML does not, or cannot encode."""

# Far above any robot's YAML (so101.yaml: 4 kB, 365 values), and read within a second.
MAX_BYTES = 256 * 1024
_MAX_VALUES = 10_000
_MAX_DEPTH = 50
_MAX_DIGITS = 40
_TOO_MANY = f"more than {_MAX_VALUES} values, including those repeated by aliases"
_TOO_DEEP = f"nested more than {_MAX_DEPTH} levels deep"


@attrs.frozen(order=True)
class Place:
    """The place of a value: line and column from 1 in a file, or an override, whose line is 0."""

    rank: int
    line: int
    column: int
    file: str


@attrs.define
class Document:
    """Plain values with the places of their keys and items, and the faults found so far."""

    root: Any
    places: dict[Key, Place]
    problems: list[tuple[Place, Problem]]
    file: str
    unread: set[Key] = attrs.field(factory=set)
    """Keys without a value, since it could not be read."""
    references: dict[Key, str] = attrs.field(factory=dict)
    """Key -> original text with `${…}`, for expanded values."""
    secrets: set[Key] = attrs.field(factory=set)
    """Keys of secret values."""

    def place(self, key: Key) -> Place:
        """The place of `key`, or of the enclosing key if it is not in the file."""
        while key and key not in self.places:
            key = key[:-1]
        return self.places.get(key, Place(0, 0, 0, self.file))

    def add(self, key: Key, message: str) -> None:
        """Add a fault at `key`, unless its value could not be read."""
        if key in self.unread:
            return
        place = self.place(key)
        self.problems.append((place, Problem(place.file, place.line, self.dotted(key), message)))

    def dotted(self, key: Key) -> str:
        """`key` in the syntax of `--set`, with list items by name if they have one; safe for a terminal."""
        words: list[str] = []
        value = self.root
        for part in key:
            value = _child(value, part)
            name = value.get("name") if isinstance(part, int) and isinstance(value, Mapping) else None
            words.append(name if isinstance(name, str) else str(part))
        return "".join(each if each.isprintable() else ascii(each)[1:-1] for each in ".".join(words))

    def get(self, *key: str | int) -> Any:
        """The value at `key`, or None."""
        value = self.root
        for part in key:
            value = _child(value, part)
        return value

    def items(self, section: str) -> list[tuple[Key, Mapping[str, Any]]]:
        """Key and value of each mapping in a section that should be a list."""
        value = self.root.get(section)
        items = value if isinstance(value, list) else ()
        return [((section, i), item) for i, item in enumerate(items) if isinstance(item, Mapping)]

    def names(self, section: str) -> list[str]:
        """The names in a section, including those of faulty items, so that each fault is reported once."""
        value = self.root.get(section)
        return list(value) if isinstance(value, Mapping) else []

    def refer(self, key: Key, name: str, known: Sequence[str], what: str) -> bool:
        """Return whether `name`, at `key`, is among the known ones; add a fault if not."""
        if name not in known:
            self.add(key, f"unknown {what} {name!r}{did_you_mean(name, known, 'known')}")
        return name in known

    def raise_problems(self) -> None:
        """Raise all faults, in file order.

        Raises:
            ConfigError: if there are any.
        """
        if self.problems:
            in_order = (problem for _, problem in sorted(self.problems, key=lambda item: item[0]))
            unique = dict.fromkeys(
                attrs.evolve(each, file=redacted(str(each.file)), message=redacted(each.message)) for each in in_order
            )
            raise ConfigError(unique)


def _child(value: Any, part: str | int) -> Any:
    if isinstance(value, Mapping):
        return value.get(part)
    if isinstance(value, Sequence) and not isinstance(value, str) and isinstance(part, int) and part < len(value):
        return value[part]
    return None


class _Composer(Composer):
    """PyYAML's composer, bounded, before a document takes time and memory."""

    _values = 0
    _depth = 0

    def compose_node(self, parent: Node | None, index: Any) -> Node | None:
        self._values += 1
        self._depth += 1
        if self._values > _MAX_VALUES or self._depth > _MAX_DEPTH + 2:  # the document and its deepest key are nodes too
            excess = _TOO_MANY if self._values > _MAX_VALUES else _TOO_DEEP
            raise _Excess(excess, self.peek_event().start_mark)  # type: ignore[attr-defined]
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node


class _Loader(_Composer, yaml.SafeLoader):
    """Without YAML 1.1 scalars; plain scalars keep their text."""


_Loader.yaml_implicit_resolvers = {}
_FastLoader: type[_Loader] = _Loader
"""Reads the same some four times as fast where PyYAML has libyaml, whose errors are worded otherwise."""
if yaml.__with_libyaml__:

    class _FastLoader(_Composer, yaml.CSafeLoader):  # type: ignore[no-redef]
        def __init__(self, text: str) -> None:
            yaml.CSafeLoader.__init__(self, text)
            Composer.__init__(self)

    _FastLoader.yaml_implicit_resolvers = {}


class _Excess(yaml.MarkedYAMLError):
    """A document beyond the size limits, detected before it takes time and memory."""

    def __init__(self, problem: str, mark: yaml.Mark) -> None:
        super().__init__(problem=problem, problem_mark=mark)


def scalar(text: str) -> str | int | float | bool | None:
    """The value of a plain scalar in the core schema of YAML 1.2: `1e-3` is a number, `on` is text.

    Raises:
        ValueError: for a number that is too long or too large.
    """
    if text in _NULLS:
        return None
    if text in _BOOLS:
        return _BOOLS[text]
    if _INT.fullmatch(text) or _BASED.fullmatch(text):
        if len(text) > _MAX_DIGITS:
            raise ValueError(f"a number of {len(text)} characters; the maximum is {_MAX_DIGITS}")
        return int(text, 0) if _BASED.fullmatch(text) else int(text)
    if _FLOAT.fullmatch(text):
        number = float(text)
        if math.isinf(number):
            raise ValueError(f"{text[:_MAX_DIGITS]} is too large for a number")
        return number
    special = _SPECIAL.fullmatch(text)
    return float(text.replace(".", "")) if special else text


def is_text(text: str) -> bool:
    """Whether the plain scalar `text` is text."""
    try:
        return isinstance(scalar(text), str)
    except ValueError:
        return False


def parse_yaml(text: str, file: str, *, expands: bool = True) -> Document:
    """Read one YAML document. The result contains faults, except for text that is not valid YAML.

    Args:
        text: the YAML.
        file: its name in faults.
        expands: whether `${NAME}` and `~/` are expanded; False for text from elsewhere, which must not read the
            environment of this machine.

    Raises:
        ConfigError: e.g. an unclosed bracket.
    """
    document = Document(None, {}, [], file)
    if len(text) > MAX_BYTES:
        raise ConfigError([Problem(file, 0, "", f"too long: a robot YAML has at most {MAX_BYTES // 1024} kB")])
    try:
        node = _compose(text)
        document.root = None if node is None else _Constructor(document, expands).value(node, ())
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = mark.line + 1 if mark else 0
        raise ConfigError([Problem(file, line, "", _reason(error))]) from None
    except yaml.YAMLError as error:
        raise ConfigError([Problem(file, 0, "", f"not valid YAML: {str(error).splitlines()[0]}")]) from None
    return document


def _compose(text: str) -> Node | None:
    if not _READ_OTHERWISE.search(text):
        with suppress(yaml.YAMLError):  # which PyYAML words as users know it
            return _FastLoader(text).get_single_node()
    return _Loader(text).get_single_node()


def _reason(error: yaml.MarkedYAMLError) -> str:
    if isinstance(error, _Excess):
        return str(error.problem)
    expected = f"{error.context}, " if error.context and error.context.startswith("expected") else ""
    return f"not valid YAML: {expected}{error.problem}"


@attrs.define
class _Constructor:
    document: Document
    _expands: bool
    _open: set[int] = attrs.field(factory=set)
    """Constructs plain values from nodes; a node met again while under construction is an alias to its own block."""
    _values: int = 0

    def place(self, node: Node) -> Place:
        return Place(0, node.start_mark.line + 1, node.start_mark.column + 1, self.document.file)

    def count(self, node: Node) -> None:
        """Count expanded nodes, and refuse too many, before aliases exhaust time and memory."""
        self._values += 1
        if self._values > _MAX_VALUES:
            raise _Excess(_TOO_MANY, node.start_mark)

    def fault(self, node: Node, key: Key, message: str) -> None:
        place = self.place(node)
        self.document.problems.append((place, Problem(place.file, place.line, self.document.dotted(key), message)))

    def value(self, node: Node, key: Key) -> Any:
        self.count(node)
        if len(key) > _MAX_DEPTH:
            raise _Excess(_TOO_DEEP, node.start_mark)
        if id(node) in self._open:
            self.fault(node, key, "an alias to the block that contains it")
            return None
        self._open.add(id(node))
        try:
            if isinstance(node, ScalarNode):
                return self.scalar(node, key)
            self.refuse_tag(node, key)
            if isinstance(node, SequenceNode):
                for i, item in enumerate(node.value):
                    self.document.places[*key, i] = self.place(item)
                return [self.value(item, (*key, i)) for i, item in enumerate(node.value)]
            return self.mapping(node, key) if isinstance(node, MappingNode) else None
        finally:
            self._open.discard(id(node))

    def refuse_tag(self, node: Node, key: Key) -> None:
        if node.tag not in _DEFAULT_TAGS:
            tag = node.tag.replace("tag:yaml.org,2002:", "!!")
            self.fault(node, key, f"unknown tag {tag}; remove it")

    def scalar(self, node: ScalarNode, key: Key) -> Any:
        self.refuse_tag(node, key)
        try:
            text = expand(node.value) if self._expands else node.value
            if text != node.value:
                self.document.references[key] = node.value
            return scalar(text) if not node.style else text
        except ValueError as error:
            self.fault(node, key, str(error))
            self.document.unread.add(key)
            return node.value

    def mapping(self, node: MappingNode, key: Key) -> dict[str, Any]:
        result: dict[str, Any] = {}
        lines: dict[str, int] = {}
        merged: list[Node] = []
        for key_node, value_node in node.value:
            if not isinstance(key_node, ScalarNode):
                self.fault(key_node, key, "a key must be a single word")
            elif key_node.value == "<<" and not key_node.style:
                merged += value_node.value if isinstance(value_node, SequenceNode) else [value_node]
            elif key_node.value in result:
                first = lines[key_node.value]
                self.fault(key_node, (*key, key_node.value), f"repeated key, first given in line {first}")
            else:
                lines[key_node.value] = key_node.start_mark.line + 1
                self.document.places[*key, key_node.value] = self.place(key_node)
                result[key_node.value] = self.value(value_node, (*key, key_node.value))
        for name, key_node, value_node in self.merged_pairs(merged, key):
            if name not in result:
                self.document.places[*key, name] = self.place(key_node)
                result[name] = self.value(value_node, (*key, name))
        return result

    def merged_pairs(self, nodes: list[Node], key: Key) -> Iterator[tuple[str, Node, Node]]:
        for node in nodes:
            if not isinstance(node, MappingNode):
                self.fault(node, key, "<< takes an alias to a mapping, or a list of them")
                continue
            for key_node, value_node in node.value:
                self.count(key_node)
                if isinstance(key_node, ScalarNode) and key_node.value == "<<":
                    self.fault(key_node, key, "<< inside a merged mapping; merge both where they are used")
                elif isinstance(key_node, ScalarNode):
                    yield key_node.value, key_node, value_node

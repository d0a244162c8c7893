"""Overrides `--set path.to.key=value`: set values in the document, which are then checked like the file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ibrobot_core.config.expand import resolve_path
from ibrobot_core.config.yaml_nodes import Document, Place, parse_yaml
from ibrobot_core.convert import Converter, Faults, Key, error_message, shown
from ibrobot_core.errors import ConfigError, Problem
from ibrobot_core.options import did_you_mean


class Override(str):
    """An override `path.to.key=value` for which the user typed something else, e.g. a flag of a viewer."""

    typed: str

    @classmethod
    def of(cls, typed: str, text: str) -> Override:
        """An override made from a flag; errors name `typed`, as the user typed it."""
        made = cls(text)
        made.typed = typed
        return made


def apply_overrides(document: Document, overrides: Sequence[str], flag: str = "--set") -> None:
    """Apply `overrides` to `document` in order; their faults are added to it, as faults of the option `flag`."""
    for rank, text in enumerate(overrides, start=1):
        place = Place(rank, 0, 0, text.typed if isinstance(text, Override) else f"{flag} {text}")
        path, equals, value_text = text.partition("=")
        if not equals or not path or not all(path.split(".")):
            message = "expected PATH=VALUE, e.g. control.rate_hz=50"
            document.problems.append((place, Problem(place.file, 0, "", message)))
            continue
        try:
            value = parse_yaml(value_text, place.file)
        except ConfigError as error:
            document.problems += [(place, Problem(place.file, 0, path, p.message)) for p in error.problems]
            continue
        for _, problem in value.problems:
            inner = f"{path}.{problem.path}" if problem.path else path
            document.problems.append((place, Problem(place.file, 0, inner, problem.message)))
        put(document, path, value, place)


def put(document: Document, path: str, value: Document, place: Place) -> None:
    """Set `path` of `document` to `value`, written at `place`; create missing sections."""
    parts = path.split(".")
    holder: Any = document.root
    key: Key = ()
    for depth, word in enumerate(parts):
        last = depth == len(parts) - 1
        try:
            part = _part(holder, word)
        except ValueError as error:
            document.problems.append((place, Problem(place.file, 0, ".".join(parts[: depth + 1]), str(error))))
            return
        key = (*key, part)
        if last:
            holder[part] = value.root
        elif isinstance(part, str) and isinstance(present := holder.get(part), str | None):
            holder[part] = {} if present is None else {"type": present}  # a component in short
            document.places[key] = place
        holder = holder[part]
    # Remove the places of keys below, so that their faults are reported as faults of the override.
    document.places = {k: known for k, known in document.places.items() if k[: len(key)] != key} | {key: place}
    others = {k: text for k, text in document.references.items() if k[: len(key)] != key}
    document.references = others | {(*key, *inner): text for inner, text in value.references.items()}


def _part(holder: Any, word: str) -> str | int:
    """`word` as a key of `holder`; for a list, an index or the name of an item."""
    if isinstance(holder, Mapping):
        return word
    if not isinstance(holder, list):
        raise ValueError(f"{shown(holder)} has no keys")
    names = [item.get("name") if isinstance(item, Mapping) else None for item in holder]
    if word in names:
        return names.index(word)
    if word.isdecimal() and int(word) < len(holder):
        return int(word)
    known = [name for name in names if isinstance(name, str)] or [str(i) for i in range(len(holder))]
    raise ValueError(f"the list has no such item{did_you_mean(word, known, 'items')}")


def single_options[T](
    kind: type[T], overrides: Sequence[str], name: str, flag: str = "--set", text: str = "{}", *, expands: bool = True
) -> T:
    """An options class, or another attrs class such as a message, checked like a section of a robot YAML.

    Args:
        kind: the class.
        overrides: `option=value` texts, e.g. `codec=h264`.
        name: name of the component in errors.
        flag: the command line's option for overrides.
        text: initial YAML, e.g. `{data: true}`.
        expands: whether `${NAME}` and `~/` in the text are expanded; see `parse_yaml`.

    Raises:
        ConfigError: with all faults.
    """
    document = parse_yaml(text, name, expands=expands)
    apply_overrides(document, overrides, flag)
    document.raise_problems()
    try:
        options: T = Converter(lambda path: resolve_path(path, Path.cwd())).structure(document.root, kind)
    except Faults as faults:
        for key, message in faults.found:
            document.add(key, message)
    except (ValueError, TypeError) as error:  # values that exclude each other
        document.add((), error_message(error))
    else:
        return options
    document.raise_problems()
    raise AssertionError("not reached: there was a fault")

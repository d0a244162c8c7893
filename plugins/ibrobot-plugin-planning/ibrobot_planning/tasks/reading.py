"""Task files: read from text, with parameters filled in."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
from unicodedata import category

import attrs
from ibrobot_kinematics.visible_names import name_fault

from ibrobot_core.api import did_you_mean
from ibrobot_core.app import ConfigError, Document, Problem, parse_yaml, single_options
from ibrobot_planning.tasks.format import Task

EXAMPLES = Path(__file__).with_name("examples")
_PARAMETER = re.compile(r"\$([A-Za-z_]\w*)")
_SHOWN = 100
"""Characters of a faulty text that its error shows."""
_PLAIN = re.compile(r"[A-Za-z][\w ./-]*")
_WORDS = ("true", "false", "null")


@attrs.frozen(eq=False)
class TaskFile:
    """A task, and the lines of its keys."""

    task: Task
    document: Document


def find_task(name: str) -> Path:
    """The file of a task: a path, or the name of one that comes with ibrobot.

    Raises:
        ConfigError: if there is neither.
    """
    bundled = {path.stem: path for path in EXAMPLES.glob("*.yaml")}
    path = Path(name)
    if path.is_file():
        return path
    if name not in bundled:
        raise ConfigError([Problem(name, 0, "", f"no such file; tasks that come with ibrobot: {', '.join(bundled)}")])
    return bundled[name]


def read_task(text: str, file: str, parameters: Sequence[str] = (), *, expands: bool = True) -> TaskFile:
    """A task from its YAML.

    Args:
        text: the YAML.
        file: its name, for errors.
        parameters: `name=value` for parameters of the task.
        expands: whether `${NAME}` and `~/` are expanded; False for tasks from other machines.

    Raises:
        ConfigError: with all faults.
    """
    raw = parse_yaml(text, file, expands=expands)
    declared = raw.root.get("parameters") if isinstance(raw.root, Mapping) else None
    values = dict(declared) if isinstance(declared, Mapping) else {}
    for each in parameters:
        name, equals, value = each.partition("=")
        flag = f"--param {each}"
        if not equals:
            raise ConfigError([Problem(flag, 0, "", "expected NAME=VALUE, e.g. hover=0.08")])
        if name not in values:
            raise ConfigError(
                [Problem(flag, 0, "", f"no parameter {name!r}{did_you_mean(name, list(values), 'known')}")]
            )
        values[name] = parse_yaml(value, flag).root
    filled = _PARAMETER.sub(lambda match: _shown(values[match[1]]) if match[1] in values else match[0], text)
    document = parse_yaml(filled, file, expands=expands)
    for key, name in _unfilled(document.root):
        document.add(key, f"no parameter {name!r}{did_you_mean(name, list(values), 'parameters')}")
    for key, words in _texts(document.root, ()):
        if key[-1:] == ("name",) and words and (fault := name_fault(words)):
            document.add(key, fault)
        elif not all(map(_is_shown, words)):
            document.add(key, f"{words[:_SHOWN]!r} has control characters")
    document.raise_problems()
    task = single_options(Task, (), file, text=filled, expands=expands)
    return TaskFile(attrs.evolve(task, name=task.name or Path(file).stem), document)


def _shown(value: Any) -> str:
    """A value as YAML, plain if possible, so that it may be part of a text."""
    if isinstance(value, str) and _PLAIN.fullmatch(value) and value.lower() not in _WORDS:
        return value
    return json.dumps(value)


def _unfilled(value: Any) -> Iterator[tuple[tuple[str | int, ...], str]]:
    """Key and name of each parameter that was not filled in."""
    for key, text in _texts(value, ()):
        for match in _PARAMETER.finditer(text):
            yield key, match[1]


def _texts(value: Any, key: tuple[str | int, ...]) -> Iterator[tuple[tuple[str | int, ...], str]]:
    """Each text in a document, with its key."""
    if isinstance(value, str):
        yield key, value
    elif isinstance(value, Mapping):
        for name, item in value.items():
            yield from _texts(item, (*key, name))
    elif isinstance(value, list):
        for i, item in enumerate(value):
            yield from _texts(item, (*key, i))


def _is_shown(character: str) -> bool:
    """Whether a text may contain a character, by the rule of requests; YAML escapes can write any."""
    return character in "\t\n" or category(character) not in ("Cc", "Cs")

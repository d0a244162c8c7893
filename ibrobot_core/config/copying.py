"""Copies of robot YAMLs with the same text, but for the defaults of `${NAME:default}`."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

from ibrobot_core.config.expand import VARIABLE
from ibrobot_core.errors import ConfigError, Problem

_ODD = re.compile(r"[{}\"'#\s\\]|:$")


def _read(source: Path) -> str:
    try:
        return source.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError([Problem(source, 0, "", f"cannot be read: {error}")]) from error


def variables_of(source: Path) -> dict[str, str]:
    """Variables in the values of a robot YAML, in order -> default; empty for those without.

    Raises:
        ConfigError: if it cannot be read.
    """
    text = _read(source)
    lines = (line.partition(" #")[0] for line in text.splitlines() if not line.lstrip().startswith("#"))
    found: dict[str, str] = {}
    for name, default in VARIABLE.findall("\n".join(lines)):
        found.setdefault(name, default)
    return found


def write_copy(source: Path, copy: Path, defaults: Mapping[str, str]) -> None:
    """Copy a robot YAML, with comments, packages and variables as they are.

    Args:
        source: the file.
        copy: a new file.
        defaults: variable -> its default in the copy; others keep theirs.

    Raises:
        ConfigError: if `copy` exists, the file cannot be read or lacks a variable, or a default cannot stand in YAML.
    """
    text, known = _read(source), variables_of(source)
    for name, value in defaults.items():
        if name not in known:
            problem = f"{source} has no variable {name!r}; its variables are: {', '.join(known) or 'none'}"
        elif _ODD.search(value):
            problem = f"{value!r} cannot be a default: no spaces, quotes, braces or #"
        else:
            continue
        raise ConfigError([Problem(f"--value {name}={value}", 0, "", problem)])

    def replace(match: re.Match[str]) -> str:
        name = match[1]
        return f"${{{name}:{defaults[name]}}}" if name in defaults else match[0]

    try:
        with copy.open("x", encoding="utf-8") as file:
            file.write(VARIABLE.sub(replace, text))
    except FileExistsError:
        raise ConfigError([Problem(copy, 0, "", "exists already, and is not overwritten")]) from None
    except OSError as error:
        raise ConfigError([Problem(copy, 0, "", f"cannot be written: {error.strerror}")]) from error

"""`ibrobot config copy`: copies of robot YAMLs with the same text, except for the defaults of `${NAME:default}`."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Mapping
from pathlib import Path

import attrs
from ibrobot_terminal.plural import counted
from ibrobot_terminal.questions import prompt

from ibrobot_core.api import option
from ibrobot_core.app import (
    VARIABLE,
    ConfigError,
    Problem,
    RequestError,
    echo,
    find_config,
    installed_plugins,
    load_config,
)

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
    variables: dict[str, str] = {}
    for name, default in VARIABLE.findall("\n".join(lines)):
        variables.setdefault(name, default)
    return variables


def _line_of(source: Path, name: str) -> str:
    """The line of a robot YAML with the first use of a variable."""
    return next(line.strip() for line in _read(source).splitlines() if f"${{{name}" in line.partition(" #")[0])


def _refuse_to_overwrite(copy: Path) -> None:
    if os.path.lexists(copy):
        raise ConfigError([Problem(copy, 0, "", "exists already, and is not overwritten")])
    if not copy.parent.is_dir():
        raise ConfigError([Problem(copy, 0, "", f"cannot be written: there is no folder {copy.parent}")])


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
    except OSError as error:
        _refuse_to_overwrite(copy)
        raise ConfigError([Problem(copy, 0, "", f"cannot be written: {error.strerror}")]) from error


@attrs.frozen(kw_only=True)
class CopyConfig:
    """Copy CONFIG to a file of your own, with your ports and cameras.

    The copy has the same text, with its comments. In a terminal, the command asks for the default of each variable,
    such as ${IBROBOT_FOLLOWER_PORT:/dev/ttyACM0}, and shows the line in which it stands; the environment still
    overrides it. `ibrobot doctor` lists what is connected. The copy is checked at the end.
    """

    config: str = option(typed="CONFIG", names="robot", help="robot YAML")
    copy: Path = option(typed="COPY", help="the new file")
    values: tuple[str, ...] = option(
        (),
        typed="--value NAME=VALUE",
        help="default of the variable ${NAME} in the copy, e.g. IBROBOT_FOLLOWER_PORT=/dev/ttyACM1",
    )
    defaults: bool = option(False, help="keep all other defaults; do not ask")

    def __call__(self) -> None:
        source = find_config(self.config, installed_plugins())
        chosen = {}
        for each in self.values:
            name, equals, value = each.partition("=")
            if not equals or not value:
                raise RequestError(f"--value: expected NAME=VALUE, got {each!r}")
            chosen[name] = value
        variables = variables_of(source)
        _refuse_to_overwrite(self.copy)
        if not self.defaults and sys.stdin.isatty():
            for name, default in variables.items():
                if name not in chosen:
                    usual = os.environ.get(name) or default
                    echo(_line_of(source, name))
                    chosen[name] = prompt(f"  {name} [{usual}]: ", flag="--defaults") or usual
        write_copy(source, self.copy, chosen)
        for name, default in variables.items():
            if (given := os.environ.get(name)) and given != chosen.get(name, default):
                echo(f"note: {name}={given} of the environment outranks the file", err=True)
        loaded = load_config(self.copy)
        body = "simulation" if loaded.simulated else "hardware"
        echo(f"{self.copy}: ok ({loaded.robot.name}, {counted(len(loaded.robot.joints), 'joint')}, {body})")

"""`ibrobot config copy`: copies of robot YAMLs with the same text, except for the defaults of `${NAME:default}`."""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping
from pathlib import Path

import click

from ibrobot_core.app import VARIABLE, ConfigError, Problem, echo, find_config, installed_plugins, load_config

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


@click.command("copy")
@click.argument("config")
@click.argument("copy", type=click.Path(path_type=Path, dir_okay=False))
@click.option(
    "--value", "values", multiple=True, metavar="NAME=VALUE",
    help="Default of the variable ${NAME} in the copy, e.g. IBROBOT_FOLLOWER_PORT=/dev/ttyACM1.",
)  # fmt: skip
@click.option("--defaults", is_flag=True, help="Keep all other defaults; do not ask.")
def config_copy(config: str, copy: Path, values: tuple[str, ...], defaults: bool) -> None:
    """Copy CONFIG to a file of your own, with your ports and cameras.

    The copy has the same text, with its comments. In a terminal, the command asks for the default of each variable,
    such as ${IBROBOT_FOLLOWER_PORT:/dev/ttyACM0}; the environment still overrides it. `ibrobot doctor` lists what is
    connected. The copy is checked at the end.
    """
    source = find_config(config, installed_plugins())
    chosen = {}
    for each in values:
        name, equals, value = each.partition("=")
        if not equals or not value:
            raise click.BadParameter(f"expected NAME=VALUE, got {each!r}", param_hint="--value")
        chosen[name] = value
    if not defaults and sys.stdin.isatty():
        for name, default in variables_of(source).items():
            if name not in chosen:
                chosen[name] = click.prompt(name, default=default or None, err=True)
    write_copy(source, copy, chosen)
    loaded = load_config(copy)
    body = "simulation" if loaded.simulated else "hardware"
    echo(f"{copy}: ok ({loaded.robot.name}, {len(loaded.robot.joints)} joints, {body})")

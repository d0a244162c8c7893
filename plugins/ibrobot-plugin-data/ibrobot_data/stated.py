"""Options that state what foreign datasets do not: names of elements, and joints that range from 0 to 100."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import click


def _parsed(context: click.Context, parameter: click.Parameter, values: tuple[str, ...]) -> Mapping[str, list[str]]:
    """Feature -> names, from texts such as `action=pan,lift`."""
    found: dict[str, list[str]] = {}
    for text in values:
        key, _, listed = text.partition("=")
        names = [name.strip() for name in listed.split(",")]
        if not key or not all(names) or key in found:
            raise click.BadParameter(f"{text!r} must be the only FEATURE=NAME,NAME,… of its feature")
        found[key] = names
    return found


def names_option(help_text: str) -> Callable[[Any], Any]:
    """The option `--names`; the command receives feature -> names of its elements in their order."""
    return click.option("--names", multiple=True, metavar="FEATURE=NAME,…", callback=_parsed, help=help_text)


def anchored_option() -> Callable[[Any], Any]:
    """The option `--anchored`; the command receives joints, or None if it is not given."""
    return click.option(
        "--anchored",
        metavar="JOINT,…",
        callback=_joints,
        help="With --calibration: joints that range from 0 to 100; by default those of the robot YAML's hardware.",
    )


def _joints(context: click.Context, parameter: click.Parameter, value: str | None) -> tuple[str, ...] | None:
    if value is None:
        return None
    return tuple(joint.strip() for joint in value.split(",") if joint.strip())

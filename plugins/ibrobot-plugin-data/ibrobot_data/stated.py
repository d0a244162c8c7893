"""Options that state what foreign datasets do not: names of elements, and joints that range from 0 to 100."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import click


def _parsed(context: click.Context, parameter: click.Parameter, values: tuple[str, ...]) -> Mapping[str, list[str]]:
    """Feature -> names, from texts such as `action=pan,lift`."""
    by_name: dict[str, list[str]] = {}
    for text in values:
        key, _, listed = text.partition("=")
        names = [name.strip() for name in listed.split(",")]
        if not key or not all(names) or key in by_name:
            raise click.BadParameter(f"{text!r} must be the only FEATURE=NAME,NAME,… of its feature")
        by_name[key] = names
    return by_name


def names_option(help_text: str) -> Callable[[Any], Any]:
    """The option `--names`; the command receives feature -> names of its elements in their order."""
    return click.option("--names", multiple=True, metavar="FEATURE=NAME,…", callback=_parsed, help=help_text)


def listed_joints(text: str | None) -> tuple[str, ...] | None:
    """Joints of a text such as `gripper,jaw`; None if there is no text."""
    return None if text is None else tuple(joint.strip() for joint in text.split(",") if joint.strip())

"""Options that state what foreign datasets do not: names of elements, and joints that range from 0 to 100."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from ibrobot_core.api import option
from ibrobot_core.app import RequestError


def names_option(help: str) -> Any:
    """The option `--names`; see `names_of`."""
    return option((), typed="--names FEATURE=NAME,…", label=None, help=help)


def names_of(texts: Iterable[str]) -> Mapping[str, list[str]]:
    """Feature -> names of its elements in their order, from texts such as `action=pan,lift`."""
    by_name: dict[str, list[str]] = {}
    for text in texts:
        key, _, listed = text.partition("=")
        names = [name.strip() for name in listed.split(",")]
        if not key or not all(names) or key in by_name:
            raise RequestError(f"--names: {text!r} must be the only FEATURE=NAME,NAME,… of its feature")
        by_name[key] = names
    return by_name


def listed_joints(text: str | None) -> tuple[str, ...] | None:
    """Joints of a text such as `gripper,jaw`; None if there is no text."""
    return None if text is None else tuple(joint.strip() for joint in text.split(",") if joint.strip())

"""The plugin's hook: `ibrobot config import` and `ibrobot config schema`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from ibrobot_core.api import Late, hookimpl
from ibrobot_core.app import Command
from ibrobot_import.formats import FORMATS


def _takes(values: Mapping[str, Any]) -> str:
    return next((each.name for each in FORMATS if each.reads(values)), "")


@hookimpl
def ibrobot_commands() -> Iterable[Command]:
    """`ibrobot config import` and `ibrobot config schema`."""
    summary = "Make a robot YAML from a config of IB-Robot, Rosetta or LeRobot."
    yield Command("config import", Late("ibrobot_import.command:ImportConfig"), summary, takes=_takes)
    yield Command("config schema", Late("ibrobot_import.schema:PrintSchema"))

"""Writes `official_plugins.json` and `official_extras.json` of core, from the plugins in this repository.

    uv sync --group cluster && python tests/house/official_plugins.py

All of them must be installed. It ends with an error that names those that are not.
"""

from __future__ import annotations

import json
import re
import sys
import tomllib
from collections.abc import Iterable
from importlib.metadata import entry_points
from pathlib import Path

from ibrobot_core.descriptors import SectionDescriptor
from ibrobot_core.errors import EXTRAS
from ibrobot_core.plugins import OFFICIAL, RECORDS, discover

PLUGINS = Path(__file__).parents[2] / "plugins"
DISTRIBUTION = PLUGINS / "ibrobot" / "pyproject.toml"


def offers() -> dict[str, dict[str, list[str]]]:
    """Package -> kind -> types, of all installed plugins of this project.

    `default`: kinds with a default type; `RECORDS`: the section that records episodes.
    """
    found: dict[str, dict[str, list[str]]] = {}
    registry = discover()
    assert not registry.failures, registry.failures
    for entry in entry_points(group="ibrobot"):
        package = entry.dist.name if entry.dist is not None else ""
        if not (PLUGINS / package).is_dir():
            continue  # core, an example, or a plugin of others
        hooks = registry.managers[entry.name].hook
        kinds: dict[str, list[str]] = {}
        for kind in registry.all_kinds:
            mine = [each for each in registry.entries.values() if (each.kind, each.package) == (kind, package)]
            if mine:
                kinds[kind] = sorted(each.descriptor.type for each in mine)
            defaults = [each.descriptor.type for each in mine if each.descriptor.default]
            if defaults:
                kinds[kind] = [*defaults, *(each for each in kinds[kind] if each not in defaults)]
                kinds.setdefault("default", []).append(kind)
            if any(
                isinstance(each.descriptor, SectionDescriptor) and each.descriptor.records_episodes for each in mine
            ):
                kinds[RECORDS] = kinds[kind]
        if readers := sorted(each.type for offered in hooks.ibrobot_readers() for each in offered):
            kinds["reader"] = readers
        if features := sorted(each.name for offered in hooks.ibrobot_features() for each in offered):
            kinds["feature"] = features
        if any(each.rectifier is not None for offered in hooks.ibrobot_decoders() for each in offered):
            kinds["rectifier"] = ["lens"]
        own = {name for name, owner in registry.command_packages.items() if owner == package}
        if commands := sorted(name for name in own if " " not in name or name.partition(" ")[0] not in own):
            kinds["command"] = commands
        if jobs := [name for name in commands if registry.commands[name].events]:
            kinds["job"] = jobs
        if kinds:
            found[package] = dict(sorted(kinds.items()))
    return dict(sorted(found.items()))


def missing(installed: Iterable[str]) -> list[str]:
    """The plugins of this repository that are not installed."""
    return sorted({folder.name for folder in PLUGINS.glob("ibrobot-plugin-*")} - set(installed))


def extras() -> dict[str, list[str]]:
    """Extra of `ibrobot` -> the plugins that it installs; without those made of other extras."""
    declared: dict[str, list[str]] = tomllib.loads(DISTRIBUTION.read_text())["project"]["optional-dependencies"]
    names = {extra: [re.split(r"[\[<>=~! ;]", each)[0] for each in content] for extra, content in declared.items()}
    return {extra: sorted(content) for extra, content in names.items() if "ibrobot" not in content}


if __name__ == "__main__":
    found = offers()
    if lacking := missing(found):
        sys.exit(f"not installed: {', '.join(lacking)}; nothing is written. Remedy: uv sync --group cluster")
    OFFICIAL.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")
    EXTRAS.write_text(json.dumps(extras(), indent=2) + "\n", encoding="utf-8")

"""Writes `ibrobot_core/official_plugins.json` from the descriptors of the plugins in this repository.

python tests/house/official_plugins.py
"""

from __future__ import annotations

import json
from importlib.metadata import entry_points

from ibrobot_core.plugins import KINDS, OFFICIAL, discover

CORE = "ibrobot-core"


def offers() -> dict[str, dict[str, list[str]]]:
    """Package -> kind -> types, of all installed plugins of this project; `default`: kinds with a default type."""
    found: dict[str, dict[str, list[str]]] = {}
    for entry in entry_points(group="ibrobot"):
        package = entry.dist.name if entry.dist is not None else ""
        if not package.startswith("ibrobot-plugin-"):
            continue
        registry = discover([entry])
        assert not registry.failures, registry.failures
        kinds: dict[str, list[str]] = {}
        for kind in KINDS:
            mine = [each for each in registry.entries.values() if (each.kind, each.package) == (kind, package)]
            if mine:
                kinds[kind] = sorted(each.descriptor.type for each in mine)
            defaults = [each.descriptor.type for each in mine if each.descriptor.default]
            if defaults:
                kinds[kind] = [*defaults, *(each for each in kinds[kind] if each not in defaults)]
                kinds.setdefault("default", []).append(kind)
        if registry.readers:
            kinds["reader"] = sorted(reader.type for reader in registry.readers)
        if registry.commands:
            kinds["command"] = sorted(registry.commands)
        found[package] = kinds
    return dict(sorted(found.items()))


if __name__ == "__main__":
    OFFICIAL.write_text(json.dumps(offers(), indent=2) + "\n", encoding="utf-8")

"""Prints JSON: the installed types that lack something on this machine, with the Debian packages that contain it."""

from __future__ import annotations

import json

from ibrobot_core.plugins import installed_plugins


def lacking() -> list[dict[str, object]]:
    """A row for each type."""
    registry = installed_plugins()
    missing = {key: registry.missing(*key) for key in sorted(registry.entries) if key not in registry.doubles}
    return [
        {"kind": kind, "type": type_, "what": each.missing, "apt": each.apt, "remedy": each.remedy}
        for (kind, type_), each in missing.items()
        if each is not None
    ]


if __name__ == "__main__":
    print(json.dumps(lacking()))

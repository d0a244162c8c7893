"""The reference page that lists what each package offers, from the plugins' descriptors."""

from __future__ import annotations

import re
from collections.abc import Iterator
from importlib.metadata import entry_points, metadata, requires
from typing import Any

import pluggy

from ibrobot_core.plugins import installed_plugins

CORE = "ibrobot-core"


def plugin_page() -> Iterator[str]:
    """Lines of the page: core first, then every installed plugin by its package's name."""
    managers = installed_plugins().managers
    packages = {point.name: point.dist.name for point in entry_points(group="ibrobot") if point.dist is not None}
    shown = sorted((packages.get(name, CORE), name) for name in managers)
    shown.sort(key=lambda pair: pair[0] != CORE)
    yield "# Plugins\n"
    yield "This page lists what core and the plugins of the repository offer. Each type links to its"
    yield "options. `ibrobot plugins` prints the list for your own installation.\n"
    yield from _needs(sorted({package for package, _ in shown if package != CORE}))
    for package, name in shown:
        yield f"## {package}\n"
        yield f"{metadata(package)['Summary']}.\n"
        yield "| kind | name | |"
        yield "|---|---|---|"
        for kind, title, summary in _offers(managers[name]):
            yield f"| {kind} | {title} | {summary} |"
        yield ""


def _needs(plugins: list[str]) -> Iterator[str]:
    """A table of what the packages need of the project, from their metadata."""
    yield "All packages need `ibrobot-core`; these need more of the project:\n"
    yield "| package | needs |"
    yield "|---|---|"
    for plugin in plugins:
        needed = {re.split(r"[^\w-]", each)[0] for each in requires(plugin) or () if "extra ==" not in each}
        if libraries := sorted(name for name in needed - {CORE, plugin} if name.startswith("ibrobot-")):
            yield f"| `{plugin}` | {', '.join(f'`{name}`' for name in libraries)} |"
    yield ""


def _offers(manager: pluggy.PluginManager) -> Iterator[tuple[str, str, str]]:
    """Kind, name and summary of everything that one plugin registers."""
    for kind, hook in installed_plugins().all_kinds.items():
        for descriptor in _yielded(manager, hook):
            yield kind, f"[`{descriptor.type}`](#options-{kind}-{descriptor.type})", descriptor.summary
    for reader in _yielded(manager, "ibrobot_readers"):
        yield "reader", f"`{reader.type}`", reader.summary
    for feature in _yielded(manager, "ibrobot_features"):
        yield "feature", f"`{feature.name}`", "paths of `select` in the contract"
    for decoder in _yielded(manager, "ibrobot_decoders"):
        yield "decoder", f"`{', '.join(decoder.formats)}`", "compressed images"
    for config in _yielded(manager, "ibrobot_configs"):
        yield "robot YAML", f"`{config.name}`", config.summary
    for command in _yielded(manager, "ibrobot_commands"):
        yield "command", f"`ibrobot {command.name}`", command.summary.rstrip(".")


def _yielded(manager: pluggy.PluginManager, hook: str) -> list[Any]:
    return [item for result in getattr(manager.hook, hook)() for item in result]

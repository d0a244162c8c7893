"""The reference page that lists what each package offers, from the plugins' descriptors.

`python docs/plugin_index.py` prints it as Markdown, for the packages of the environment of this Python.
"""

from __future__ import annotations

from collections.abc import Iterator
from importlib.metadata import entry_points, metadata, requires, version
from typing import Any

import pluggy
from packaging.requirements import Requirement

from ibrobot_core.plugins import installed_plugins

CORE = "ibrobot-core"


def plugin_page() -> Iterator[str]:
    """Lines of the page: core first, then every installed plugin by its package's name."""
    managers = installed_plugins().managers
    packages = {point.name: point.dist.name for point in entry_points(group="ibrobot") if point.dist is not None}
    shown = sorted((packages.get(name, CORE), name) for name in managers)
    shown.sort(key=lambda pair: pair[0] != CORE)
    yield "# Plugins\n"
    yield "This page lists what core and the installed plugins offer. Each type links to its"
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
    """A table of the packages: the versions of core that they work with, and the project's packages that they need."""
    yield "| package | version | works with | needs |"
    yield "|---|---|---|---|"
    for plugin in plugins:
        needed = [Requirement(each) for each in requires(plugin) or () if "extra ==" not in each]
        core = ", ".join(f"`{each.name}{each.specifier}`" for each in needed if each.name == CORE)
        names = {each.name for each in needed} - {CORE, plugin}
        libraries = ", ".join(f"`{name}`" for name in sorted(names) if name.startswith("ibrobot-"))
        yield f"| `{plugin}` | {version(plugin)} | {core} | {libraries} |"
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


if __name__ == "__main__":
    print("\n".join(plugin_page()))

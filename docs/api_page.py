"""The reference page of core's public interface: both floors, in the groups of their stubs."""

from __future__ import annotations

import ast
import inspect
import re
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

from ibrobot_core import api, app

ELSEWHERE = {"ibrobot_core.interfaces": "interfaces", "ibrobot_core.descriptors": "hooks"}
"""Package or module -> the page that describes it whole."""

STABILITY = """# Public API

Plugins import core through two flat modules. `ibrobot_core.api` is the floor for devices, models and formats:

```python
from ibrobot_core.api import Context, Teleop, TeleopCommand, TeleopDescriptor, hookimpl, option
```

`ibrobot_core.app` is the floor for what reaches into a run: commands, sections of the robot YAML, command sources,
sessions and topics.

```python
from ibrobot_core.app import Command, Component, SectionDescriptor, Session
```

A name is imported from its module when it is first used. Listing plugins therefore loads no heavy package.

## What is stable

The names on this page are the public API, together with the [hooks](hooks.md), the [robot YAML](config.md), the
[command line](cli.md) and its [exit codes](exit-codes.md). Everything else in `ibrobot_core` may change in any release.

- A new release may add names, optional arguments, methods that are not abstract, and fields with a default.
- A name, an argument or a meaning is removed in three steps. A release announces it in the
  [changelog](changelog.md) and gives a `DeprecationWarning` that names the replacement. The old name then works in at
  least one more minor release. After that a minor release (a major one, from 1.0 on) removes it.
- Messages, log lines and the order of listings are for people. They may change at any time.

The official plugins use nothing else of core. `nox -s layers` checks it.
"""


def groups(floor: ModuleType) -> Iterator[tuple[str, list[str]]]:
    """The title and the names of each group of a floor: comments of its stub are titles of what follows."""
    stub = Path(str(floor.__file__)).with_suffix(".pyi").read_text(encoding="utf-8")
    titles = [number for number, line in enumerate(stub.splitlines(), start=1) if line.startswith("# ")]
    imports = [node for node in ast.parse(stub).body if isinstance(node, ast.ImportFrom)]
    for number, following in zip(titles, [*titles[1:], len(stub)], strict=True):
        inside = [node for node in imports if number < node.lineno < following]
        yield stub.splitlines()[number - 1].removeprefix("# "), [alias.name for node in inside for alias in node.names]


def api_page() -> Iterator[str]:
    """Lines of the page, which has a page for each group."""
    yield STABILITY
    for floor in (api, app):
        yield f"## {floor.__name__}\n"
        for title, names in groups(floor):
            yield f"- [{title}](api/{_part(floor, title)}.md): {', '.join(f'`{name}`' for name in names)}"
        yield ""
    yield "```{toctree}\n:hidden:\n"
    yield from (f"api/{name}" for name in api_parts())
    yield "```\n"


def api_parts() -> dict[str, Iterator[str]]:
    """Name -> lines of the page on a group."""
    return {
        _part(floor, title): _group_page(floor, title, names) for floor in (api, app) for title, names in groups(floor)
    }


def _part(floor: ModuleType, title: str) -> str:
    return re.sub(r"\W+", "-", f"{floor.__name__.rpartition('.')[2]} {title}".lower())


def _group_page(floor: ModuleType, title: str, names: list[str]) -> Iterator[str]:
    yield f"# {title}\n"
    yield f"Names of `{floor.__name__}`.\n"
    homes = {name: floor.home_of(name) for name in names}
    for module, page in ELSEWHERE.items():
        found = [name for name, home in homes.items() if f"{home}.".startswith(f"{module}.")]
        if found:
            listed = ", ".join(f"`{name}`" for name in found)
            yield f"[{page.capitalize()}](../{page}.md) describes: {listed}.\n"
        homes = {name: home for name, home in homes.items() if name not in found}
    if homes:
        yield from _described(floor, homes)


def _described(floor: ModuleType, homes: dict[str, str]) -> Iterator[str]:
    yield "```{eval-rst}"
    for name, home in homes.items():
        value = getattr(floor, name)
        kind = "class" if inspect.isclass(value) else "function" if inspect.isroutine(value) else "data"
        yield f".. auto{kind}:: {home}.{name}"
        if kind == "data":
            yield "   :no-value:"
    yield "```\n"

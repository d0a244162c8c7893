"""The reference page of `ibrobot_core.api`: every public name, grouped by the module that it lives in."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from importlib import import_module

from ibrobot_core import api

ELSEWHERE = {"ibrobot_core.interfaces": "interfaces", "ibrobot_core.descriptors": "hooks"}
"""Module -> the page that describes it whole."""

STABILITY = """# Public API

Plugins import core through one flat module:

```python
from ibrobot_core.api import Context, Teleop, TeleopCommand, TeleopDescriptor, hookimpl, option
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

The official plugins use nothing else of core. `lint-imports` checks it.
"""


def api_page() -> Iterator[str]:
    """Lines of the page."""
    yield STABILITY
    names: dict[str, list[str]] = {}
    for name in api.__all__:
        home = api.home_of(name)
        group = "ibrobot_core.interfaces" if home.startswith("ibrobot_core.interfaces") else home
        names.setdefault(group, []).append(name)
    for module, found in names.items():
        yield f"## {module.removeprefix('ibrobot_core.')}\n"
        yield f"{(inspect.getdoc(import_module(module)) or '').split('\n\n', maxsplit=1)[0]}\n"
        if module in ELSEWHERE:
            page = ELSEWHERE[module]
            yield f"[{page.capitalize()}]({page}.md) describes them: {', '.join(f'`{name}`' for name in found)}.\n"
            continue
        yield "```{eval-rst}"
        for name in found:
            value = getattr(api, name)
            kind = "class" if inspect.isclass(value) else "function" if inspect.isroutine(value) else "data"
            yield f".. auto{kind}:: {module}.{name}"
            if kind == "data":
                yield "   :no-value:"
        yield "```\n"

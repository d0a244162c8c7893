"""The public interface of core: everything that a plugin needs, in one flat module.

    from ibrobot_core.api import Context, Teleop, TeleopCommand, TeleopDescriptor, hookimpl, option

Each name is imported from its module on first use, so that a plugin's descriptors import nothing heavy. Names here
are stable, as the page "Public API" of the documentation defines. Everything else in `ibrobot_core` may change at any
time.
"""

from __future__ import annotations

import ast
from importlib import import_module
from pathlib import Path
from typing import Any


def _homes() -> dict[str, str]:
    """Name -> module that defines it, from this module's stub, which type checkers read."""
    stub = ast.parse(Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
    imports = (node for node in stub.body if isinstance(node, ast.ImportFrom))
    return {alias.name: str(node.module) for node in imports for alias in node.names}


_HOMES = _homes()

__all__ = list(_HOMES)


def home_of(name: str) -> str:
    """The module that defines a name of the API."""
    return _HOMES[name]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_HOMES[name]), name)
    return value


def __dir__() -> list[str]:
    return [*globals(), *_HOMES]

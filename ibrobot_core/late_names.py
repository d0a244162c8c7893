"""Modules that import their names on first use, from the homes that their stubs give."""

from __future__ import annotations

import ast
import sys
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Any


class LateNames:
    """The names of a module.

    Args:
        module: its `__name__`.
        file: its `__file__`, beside which is the stub that type checkers read.
    """

    def __init__(self, module: str, file: str) -> None:
        self._module = module
        self._stub = Path(file).with_suffix(".pyi")

    @cached_property
    def homes(self) -> dict[str, str]:
        """Name -> module that defines it."""
        stub = ast.parse(self._stub.read_text(encoding="utf-8"))
        imports = (node for node in stub.body if isinstance(node, ast.ImportFrom))
        return {alias.name: str(node.module) for node in imports for alias in node.names}

    def listed(self) -> list[str]:
        """The names, for `__all__` and `__dir__`."""
        return list(self.homes)

    def home_of(self, name: str) -> str:
        """The module that defines a name."""
        return self.homes[name]

    def load(self, name: str) -> Any:
        """Import a name from its home into the module; the module's `__getattr__`.

        Raises:
            AttributeError: if the module has no such name.
        """
        if name not in self.homes:
            raise AttributeError(f"module {self._module!r} has no attribute {name!r}")
        value = getattr(import_module(self.homes[name]), name)
        setattr(sys.modules[self._module], name, value)
        return value

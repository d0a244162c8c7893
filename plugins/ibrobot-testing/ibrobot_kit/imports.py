"""Import statements in the order and form in which `ruff` wants them."""

from __future__ import annotations

import sys
from collections.abc import Iterable

_WIDTH = 120


def arranged(statements: Iterable[str], own: str) -> str:
    """Import statements, in groups, each name once.

    Args:
        statements: e.g. `import attrs`, `from pathlib import Path`.
        own: the package in which they stand, which is imported last.
    """
    whole = sorted({each for each in statements if each.startswith("import ")}, key=_module)
    names: dict[str, set[str]] = {}
    for each in statements:
        if each.startswith("from "):
            _, module, _, name = each.split(" ", 3)
            names.setdefault(module, set()).update(part.strip() for part in name.split(","))
    groups = []
    for group in range(3):
        lines = [each for each in whole if _group(_module(each), own) == group]
        lines += [_line(module, names[module]) for module in sorted(names) if _group(module, own) == group]
        groups += ["\n".join(lines)] if lines else []
    return "\n\n".join(groups)


def _module(statement: str) -> str:
    return statement.split()[1]


def _group(module: str, own: str) -> int:
    """0: the standard library; 1: other packages; 2: the own one."""
    package = module.partition(".")[0]
    return 0 if package in sys.stdlib_module_names else 2 if package == own else 1


def _line(module: str, names: Iterable[str]) -> str:
    ordered = sorted(names, key=lambda name: (_rank(name), name.casefold(), name))
    line = f"from {module} import {', '.join(ordered)}"
    if len(line) <= _WIDTH:
        return line
    return "\n".join((f"from {module} import (", *(f"    {each}," for each in ordered), ")"))


def _rank(name: str) -> int:
    """Constants come before classes, and these before functions."""
    return 0 if len(name) > 1 and name.isupper() else 1 if name[:1].isupper() else 2

"""A class of a module as a module of its own: with what it uses of that module, and its imports."""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from types import ModuleType

_WIDTH = 88


def excerpt(module: ModuleType, name: str) -> tuple[list[str], str]:
    """Cut a class out of a module.

    Args:
        module: a module that imports no names under conditions.
        name: the class.

    Returns:
        Its import statements, with empty lines between their groups, and the text of what it uses of the module and of
        itself, in their order.
    """
    file = module.__file__
    assert file is not None
    with open(file, encoding="utf-8") as opened:
        text = opened.read()
    tree = ast.parse(text)
    own = {node.name: node for node in tree.body if isinstance(node, ast.ClassDef | ast.FunctionDef)}
    wanted: set[str] = set()
    todo = [name]
    while todo:
        node = own[todo.pop()]
        wanted.add(node.name)
        todo += [used for used in _names(node) if used in own and used not in wanted]
    nodes = [node for key, node in own.items() if key in wanted]
    used = {each for node in nodes for each in _names(node)}
    imports: list[str] = []
    for statement in tree.body:
        for line in _import(statement, used):
            if imports and _group(line) != _group(imports[-1]):
                imports.append("")
            imports.append(line)
    lines = text.splitlines()
    parts = []
    for node in nodes:
        first = min([node.lineno, *(decorator.lineno for decorator in node.decorator_list)])
        parts.append("\n".join(lines[first - 1 : node.end_lineno]))
    return imports, "\n\n\n".join(parts)


def _group(line: str) -> int:
    """The place of an import statement: the standard library's come first, and those of ibrobot last."""
    package = line.split()[1].partition(".")[0]
    return 0 if package in sys.stdlib_module_names else 2 if package == "ibrobot_core" else 1


def _names(node: ast.AST) -> Iterator[str]:
    return (each.id for each in ast.walk(node) if isinstance(each, ast.Name))


def _import(node: ast.stmt, used: set[str]) -> Iterator[str]:
    """An import statement without what is not used; nothing if it is none, or nothing of it is used."""
    if isinstance(node, ast.Import):
        for alias in node.names:
            if (alias.asname or alias.name) in used:
                yield f"import {alias.name}" + (f" as {alias.asname}" if alias.asname else "")
    elif isinstance(node, ast.ImportFrom) and node.module != "__future__":
        names = [alias.name for alias in node.names if alias.name in used]
        line = f"from {node.module} import {', '.join(names)}"
        if names and len(line) > _WIDTH:
            yield "\n".join((f"from {node.module} import (", *(f"    {each}," for each in names), ")"))
        elif names:
            yield line

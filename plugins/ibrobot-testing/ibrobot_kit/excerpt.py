"""A class or function of a module as a module of its own: with what it uses of that module, and its imports."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from types import ModuleType


def excerpt(module: ModuleType, name: str) -> tuple[list[str], str]:
    """Cut a class or a function out of a module.

    Args:
        module: a module that imports no names under conditions.
        name: the class or function.

    Returns:
        Its import statements, and the text of what it uses of the module and of itself, in their order.
    """
    file = module.__file__
    assert file is not None
    with open(file, encoding="utf-8") as opened:
        text = opened.read()
    tree = ast.parse(text)
    own = {defined: node for node in tree.body for defined in _defined(node)}
    wanted: dict[str, ast.stmt] = {}
    todo = [name]
    while todo:
        each = todo.pop()
        wanted[each] = own[each]
        todo += [used for used in _names(own[each]) if used in own and used not in wanted]
    nodes = [node for key, node in own.items() if key in wanted]
    used = {each for node in nodes for each in _names(node)}
    imports = [line for statement in tree.body for line in _import(statement, used)]
    lines = text.splitlines()
    parts: list[str] = []
    for node in nodes:
        first, gap = node.lineno, "\n"
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            first, gap = min([first, *(each.lineno for each in node.decorator_list)]), "\n\n\n"
        parts.append((gap if parts else "") + "\n".join(lines[first - 1 : node.end_lineno]))
    return imports, "".join(parts)


def _defined(node: ast.stmt) -> list[str]:
    """The names that a statement defines: of a class, a function or a constant."""
    if isinstance(node, ast.ClassDef | ast.FunctionDef):
        return [node.name]
    targets = node.targets if isinstance(node, ast.Assign) else []
    return [each.id for target in targets for each in ast.walk(target) if isinstance(each, ast.Name)]


def _names(node: ast.AST) -> Iterator[str]:
    return (each.id for each in ast.walk(node) if isinstance(each, ast.Name))


def _import(node: ast.stmt, used: set[str]) -> Iterator[str]:
    """An import statement of each name that is used."""
    if isinstance(node, ast.Import):
        for alias in node.names:
            if (alias.asname or alias.name.partition(".")[0]) in used:
                yield f"import {alias.name}" + (f" as {alias.asname}" if alias.asname else "")
    elif isinstance(node, ast.ImportFrom) and node.module != "__future__":
        for alias in node.names:
            if alias.name in used:
                yield f"from {node.module} import {alias.name}"

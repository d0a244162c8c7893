"""No files of a package import one another in a circle; imports for types count, and those within functions."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGES = sorted(path.parent for path in (Path(__file__).parents[2] / "plugins").glob("*/*ibrobot*/__init__.py"))


def imported(name: str, text: str) -> Iterator[str]:
    """What a file of package `name` may import of it: modules, and names in them that may be modules."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.ImportFrom) and (module := node.module or "").split(".")[0] == name:
            yield from (f"{module}.{each.name}" for each in node.names)


def circle(package: Path) -> list[str]:
    """The files of a package that import themselves by others."""
    files = {".".join(path.relative_to(package.parent).with_suffix("").parts): path for path in package.rglob("*.py")}
    files = {name.removesuffix(".__init__"): path for name, path in files.items()}
    imports = {
        name: {each if each in files else each.rpartition(".")[0] for each in imported(package.name, path.read_text())}
        for name, path in files.items()
    }

    def reached(begin: str) -> set[str]:
        known: set[str] = set()
        waiting = [begin]
        while waiting:
            new = imports.get(waiting.pop(), set()) - known
            known |= new
            waiting += new
        return known

    return [name for name in files if name in reached(name)]


@pytest.mark.parametrize("package", PACKAGES, ids=lambda package: package.name)
def test_files_import_one_another_in_no_circle(package: Path) -> None:
    assert not (tied := circle(package)), f"a circle: {', '.join(tied)}"

"""Every check of every conformance suite is shown to fail: a test names a wrong implementation for each."""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import TypeGuard

PLUGINS = Path(__file__).parents[2] / "plugins"


@cache
def of_packages() -> dict[str, tuple[Path, ast.ClassDef, list[str]]]:
    """The classes of the packages' files about suites."""
    files = PLUGINS.glob("*/ibrobot_*/**/*.py")
    return classes(file for file in files if "Suite" in file.read_text(encoding="utf-8"))


def classes(files: Iterable[Path]) -> dict[str, tuple[Path, ast.ClassDef, list[str]]]:
    """Name -> file, class and names of its bases."""
    return {
        node.name: (file, node, [name for base in node.bases if (name := name_of(base))])
        for file in files
        for node in ast.parse(file.read_text(encoding="utf-8")).body
        if isinstance(node, ast.ClassDef)
    }


def name_of(base: ast.expr) -> str:
    """The name of a base class, without its parameters."""
    return name_of(base.value) if isinstance(base, ast.Subscript) else base.id if isinstance(base, ast.Name) else ""


def suites() -> dict[str, set[str]]:
    """Suite -> its own checks, of all packages."""
    known = of_packages()

    def is_suite(name: str) -> bool:
        return name == "Suite" or (name in known and any(map(is_suite, known[name][2])))

    checks = {
        name: {each.name for each in node.body if isinstance(each, ast.FunctionDef) and each.name.startswith("test_")}
        for name, (_, node, _) in known.items()
        if is_suite(name)
    }
    return {name: each for name, each in checks.items() if each}


def compared() -> Iterator[str]:
    """The suites whose checks a test compares with those that its wrong implementations fail, and their bases."""
    for file in PLUGINS.glob("*/tests/test_*.py"):
        text = file.read_text(encoding="utf-8")
        if "test_every_check_catches_something" not in text:
            continue
        own = of_packages() | classes([file])
        for node in ast.parse(text).body:
            if isinstance(node, ast.FunctionDef) and node.name == "test_every_check_catches_something":
                todo = [name_of(call.args[0]) for call in ast.walk(node) if is_checks(call)]
                for name in todo:
                    yield name
                    todo += own[name][2] if name in own else []


def is_checks(node: ast.AST) -> TypeGuard[ast.Call]:
    return isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "checks"


def test_every_suite_has_wrong_implementations_for_all_of_its_checks() -> None:
    assert sorted(suites().keys() - set(compared())) == []


def test_there_are_suites_with_checks() -> None:
    found = suites()
    assert len(found) >= 16
    assert sum(map(len, found.values())) > 170
    assert {"HardwareSuite", "SimulatedHardwareSuite", "SceneSuite", "PoolSuite", "CauseSuite"} <= found.keys()


def test_every_check_says_what_it_checks() -> None:
    silent = [
        f"{name}.{each.name}"
        for name in suites()
        for each in of_packages()[name][1].body
        if isinstance(each, ast.FunctionDef) and each.name.startswith("test_") and not ast.get_docstring(each)
    ]
    assert silent == []

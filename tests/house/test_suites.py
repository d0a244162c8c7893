"""Every check of every conformance suite is shown to fail: a test of its package names a wrong implementation for each."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PLUGINS = Path(__file__).parents[2] / "plugins"


def classes(files: Iterator[Path]) -> dict[str, tuple[Path, ast.ClassDef, list[str]]]:
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
    known = classes(PLUGINS.glob("*/ibrobot_*/**/*.py"))

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
    of_packages = classes(PLUGINS.glob("*/ibrobot_*/**/*.py"))
    for file in PLUGINS.glob("*/tests/test_*.py"):
        own = of_packages | classes(iter([file]))
        for node in ast.parse(file.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.FunctionDef) and node.name == "test_every_check_catches_something":
                todo = [name_of(call.args[0]) for call in ast.walk(node) if is_checks(call)]
                for name in todo:
                    yield name
                    todo += own[name][2] if name in own else []


def is_checks(node: ast.AST) -> bool:
    return isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "checks"


def test_every_suite_has_wrong_implementations_for_all_of_its_checks() -> None:
    assert sorted(suites().keys() - set(compared())) == []


def test_there_are_suites_with_checks() -> None:
    found = suites()
    assert len(found) >= 16
    assert sum(map(len, found.values())) > 170
    assert {"HardwareSuite", "SimulatedHardwareSuite", "SceneSuite", "PoolSuite", "CauseSuite"} <= found.keys()


@pytest.mark.parametrize("name", sorted(suites()))
def test_every_check_says_what_it_checks(name: str) -> None:
    file, node, _ = classes(PLUGINS.glob("*/ibrobot_*/**/*.py"))[name]
    silent = [
        each.name
        for each in node.body
        if isinstance(each, ast.FunctionDef) and each.name.startswith("test_") and not ast.get_docstring(each)
    ]
    assert silent == [], file

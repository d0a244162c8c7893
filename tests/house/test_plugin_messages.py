"""Every message about a plugin, of discovery and of `ibrobot plugins check`, is asserted by a test."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SAYING = {
    "ibrobot_core/plugins.py": None,
    "ibrobot_core/descriptors.py": None,
    "ibrobot_core/options.py": ("mistakes",),
    "plugins/ibrobot-testing/ibrobot_kit/check.py": None,
    "plugins/ibrobot-testing/ibrobot_kit/new.py": None,
    "plugins/ibrobot-testing/ibrobot_kit/repository.py": None,
}
"""Module -> the functions whose messages count, or all."""
SPEAKERS = ("Check", "Failure", "MissingDependency", "refuse")
"""Calls whose texts are messages, beside those that are raised."""
NAMED = ("remedy", "reason", "text", "failure")
"""Variables whose texts become messages."""
ASSERTING = (
    "tests/test_plugins.py",
    "tests/test_bad_plugins.py",
    "tests/test_mistakes_of_plugins.py",
    "tests/cli",
    "tests/house",
    "plugins/ibrobot-testing/tests",
)
LENGTH = 14
"""Letters in a row that a test must have of a message; all of them if it is shorter."""


def messages(file: Path, functions: tuple[str, ...] | None) -> Iterator[tuple[int, list[str]]]:
    """Line and constant parts of each message of a module."""
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if not isinstance(node, ast.FunctionDef) or (functions is not None and node.name not in functions):
            continue
        for part in ast.walk(node):
            if isinstance(part, ast.Raise) and isinstance(part.exc, ast.Call):
                yield from texts(*part.exc.args)
            elif isinstance(part, ast.Call) and spoken(part.func) in SPEAKERS:
                yield from texts(*part.args, *(each.value for each in part.keywords))
            elif (isinstance(part, ast.Assign) and spoken(part.targets[0]) in NAMED) or (
                isinstance(part, ast.Yield) and part.value is not None and node.name.endswith("mistakes")
            ):
                assert part.value is not None
                yield from texts(part.value)


def spoken(function: ast.expr) -> str:
    return (
        function.attr if isinstance(function, ast.Attribute) else function.id if isinstance(function, ast.Name) else ""
    )


def texts(*nodes: ast.expr) -> Iterator[tuple[int, list[str]]]:
    """The texts in expressions: of those that are chosen by a condition, each."""
    for node in nodes:
        if isinstance(node, ast.IfExp):
            yield from texts(node.body, node.orelse)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value:
            yield node.lineno, [node.value]
        elif isinstance(node, ast.JoinedStr):
            yield from texts(*(each.value for each in node.values if isinstance(each, ast.FormattedValue)))
            yield node.lineno, [str(each.value) for each in node.values if isinstance(each, ast.Constant)]
        elif isinstance(node, ast.BinOp):
            yield from texts(node.left, node.right)


def asserted() -> str:
    """All texts of the tests, without what regular expressions escape."""
    paths = [
        path
        for each in ASSERTING
        for path in ((ROOT / each).rglob("*.py") if (ROOT / each).is_dir() else [ROOT / each])
    ]
    found = []
    for path in paths:
        if path != Path(__file__):
            nodes = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
            found += [each.value for each in nodes if isinstance(each, ast.Constant) and isinstance(each.value, str)]
    return "\n".join(found).replace("\\", "")


def is_in(part: str, tests: str) -> bool:
    """Whether tests have enough of a constant part."""
    part = part.strip(" :;,.\n")
    return any(part[at : at + LENGTH] in tests for at in range(max(1, len(part) - LENGTH + 1)))


def test_every_message_is_asserted() -> None:
    tests, silent, number = asserted(), [], 0
    for name, functions in SAYING.items():
        for line, parts in messages(ROOT / name, functions):
            long = [part for part in parts if len(part.strip(" :;,.\n")) >= 6]
            number += bool(long)
            if long and not any(is_in(part, tests) for part in long):
                silent.append(f"{name}:{line}: {' … '.join(parts)}")
    assert silent == []
    assert number > 60


@pytest.mark.parametrize("text", ["it returned None: yield what it offers", "make is None: give a class"])
def test_a_message_that_no_test_has_is_found(text: str) -> None:
    assert is_in(text, asserted())
    assert not is_in(text[::-1], asserted())

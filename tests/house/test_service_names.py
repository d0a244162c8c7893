"""Services that code calls by a literal name are declared: a misspelt one would be skipped in silence."""

from __future__ import annotations

import ast
import re
from collections.abc import Collection, Iterator
from difflib import get_close_matches
from functools import cache
from pathlib import Path

import pytest

pytest.importorskip("ibrobot_ros2")
from plain_requests import declared

ROOT = Path(__file__).parents[2]
OTHERS = {"/task/status", "/task/events", "/agent/log", "/moveit_gateway/motion_status", "/rosapi/services", "/stop"}
"""Topics beside services, services of other programs, and addresses of pages."""
CALLS = {"call", "serves", "unserve", "ask"}
"""Methods that take a service's name first."""


def named(text: str, known: Collection[str]) -> Iterator[tuple[int, str]]:
    """Line and text of each literal that is called as a service, begins as one, or resembles one."""
    if not re.search(r"""["'}]/[a-z_]""", text):  # what begins a literal or goes on in one
        return
    first_words = {name.split("/")[1] for name in known if name.count("/") > 1}
    tree = ast.parse(text)
    called = {
        id(node.args[0])
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in CALLS and node.args
    }
    close = cache(lambda name: bool(get_close_matches(name, known, 1, 0.85)))
    for node in ast.walk(tree):
        if not isinstance(node, ast.Constant) or not isinstance(name := node.value, str):
            continue
        if not re.fullmatch(r"(/[a-z_]+)+", name):
            continue
        words = name.split("/")
        begins = len(words) > 2 and words[1] in first_words
        if id(node) in called or begins or close(name):
            yield node.lineno, name


@pytest.mark.integration
def test_every_literal_that_names_a_service_names_one_that_is_declared() -> None:
    known = declared()
    assert {"/planning/go_to", "/task/run", "/world/add", "/agent/arm", "/estop"} <= known.keys()
    wrong = [
        f"{path.relative_to(ROOT)}:{line}: {name}"
        for package in (ROOT / "ibrobot_core", *(ROOT / "plugins").glob("*/*ibrobot*"))
        for path in package.rglob("*.py")
        for line, name in named(path.read_text(encoding="utf-8"), known)
        if name not in known and name not in OTHERS
    ]
    assert wrong == []


def test_misspelt_names_are_found() -> None:
    known = ("/set_mode", "/estop", "/planning/go_to")
    text = 'MODE = "/set_mod"\nOTHER = ("/planning/stop", "/camera")\nif bus.serves("/stop"): pass\n'
    assert [name for _, name in named(text, known)] == ["/set_mod", "/planning/stop", "/stop"]

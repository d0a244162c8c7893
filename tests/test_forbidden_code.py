"""Nothing in the tree unpickles, evaluates, or loads weights that may hold code."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = ("ibrobot_core", "plugins", "benchmarks", "docs")
MODULES = {"pickle", "cPickle", "_pickle", "dill", "cloudpickle", "joblib", "marshal", "shelve"}
CALLS = {"eval", "exec", "compile", "__import__"}


def offences(source: str) -> Iterator[str]:
    """What there is in a module that could run what a stranger sent, with its line."""
    for node in ast.walk(ast.parse(source)):
        names: list[str] = []
        match node:
            case ast.Import(names=aliases):
                names = [alias.name for alias in aliases]
            case ast.ImportFrom(module=str(module)):
                names = [module]
            case ast.Call(func=ast.Name(id=name)) if name in CALLS:
                yield f"line {node.lineno}: {name}()"
            case ast.Call(func=ast.Attribute(value=ast.Name(id="torch"), attr="load"), keywords=keywords):
                safe = [k for k in keywords if k.arg == "weights_only" and getattr(k.value, "value", None) is True]
                if not safe:
                    yield f"line {node.lineno}: torch.load without weights_only=True"
            case ast.Call(keywords=keywords):
                for keyword in keywords:
                    value = getattr(keyword.value, "value", None)
                    if (keyword.arg, value) in (("weights_only", False), ("allow_pickle", True)):
                        yield f"line {node.lineno}: {keyword.arg}={value}"
        for name in names:
            if name.split(".")[0] in MODULES:
                yield f"line {node.lineno}: import {name}"


def sources() -> list[Path]:
    return sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py") if ".venv" not in path.parts)


def test_nothing_unpickles_or_evaluates():
    found = {str(path.relative_to(ROOT)): list(offences(path.read_text())) for path in sources()}
    assert len(found) > 100
    assert {name: offence for name, offence in found.items() if offence} == {}


@pytest.mark.parametrize(
    "source",
    [
        "import pickle",
        "from pickle import loads",
        "import numpy, dill",
        "x = eval(text)",
        "exec(text)",
        "torch.load(path)",
        "torch.load(path, weights_only=False)",
        "load(path, weights_only=False)",
        "np.load(path, allow_pickle=True)",
    ],
)
def test_the_check_finds_it(source: str):
    assert list(offences(source))


@pytest.mark.parametrize("source", ["torch.load(path, weights_only=True)", "re.compile(text)", "evaluate(x)"])
def test_the_check_lets_the_rest_be(source: str):
    assert not list(offences(source))

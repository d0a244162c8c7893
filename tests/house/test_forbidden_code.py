"""Nothing in the tree unpickles, evaluates, or loads weights that may hold code."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FOLDERS = ("ibrobot_core", "plugins", "benchmarks", "docs", "tests")
MODULES = {"pickle", "cPickle", "_pickle", "dill", "cloudpickle", "joblib", "marshal", "shelve"}
CALLS = {"eval", "exec", "compile", "__import__"}
METHODS = {"unsafe_load", "full_load", "unsafe_load_all", "full_load_all", "read_pickle", "to_pickle", "Unpickler"}
UNSAFE = (("weights_only", False), ("allow_pickle", True))
_SERVERS = "plugins/ibrobot-plugin-policy-servers"
WRITERS = {f"{_SERVERS}/ibrobot_policy_servers/lerobot_server.py"}
"""Files that may import pickle to write what LeRobot's server reads, and for nothing else."""
PICKLES_OF_TESTS = {f"{_SERVERS}/tests/lerobot_server.py", f"{_SERVERS}/tests/test_hostile_pickles.py"}
"""Tests that read their own pickles, as LeRobot does, and show that hostile ones would run there."""
LOADERS = {"SafeLoader", "CSafeLoader"}


_NAMED = "|".join((*MODULES, *METHODS, *(name for name, _ in UNSAFE)))
SUSPECT = re.compile(rf"\b(?:{_NAMED}|(?:torch|yaml)\s*\.\s*load)\b|(?<![.\w])(?:{'|'.join(CALLS)})\b")
"""What a text without an offence may have as well; parsing all files takes seconds."""


def offences(source: str) -> Iterator[str]:
    """What there is in a module that could run what a stranger sent, with its line."""
    if source.isascii() and not SUSPECT.search(source):  # Python reads some other letters as these
        return
    for node in ast.walk(ast.parse(source)):
        found: list[str] = []
        match node:
            case ast.Import(names=aliases):
                found = _imported(*(alias.name for alias in aliases))
            case ast.ImportFrom(module=str(module)):
                found = _imported(module)
            case ast.Call(func=ast.Attribute(attr="import_module"), args=[ast.Constant(value=str(module))]):
                found = _imported(module)
            case ast.Call():
                found = _called(node)
        yield from (f"line {node.lineno}: {each}" for each in found)  # type: ignore[attr-defined]


def _imported(*modules: str) -> list[str]:
    return [f"import {module}" for module in modules if module.split(".")[0] in MODULES]


def _called(call: ast.Call) -> list[str]:
    given = {keyword.arg: getattr(keyword.value, "value", None) for keyword in call.keywords}
    found = [f"{name}={value}" for name, value in UNSAFE if (name, value) in given.items()]
    match call.func:
        case ast.Name(id=name) if name in CALLS:
            found.append(f"{name}()")
        case ast.Attribute(attr=name) if name in METHODS:
            found.append(f"{name}()")
        case ast.Attribute(value=ast.Name(id="torch"), attr="load") if given.get("weights_only") is not True:
            found.append("torch.load without weights_only=True")
        case ast.Attribute(value=ast.Name(id="yaml"), attr="load"):
            names = {getattr(part, "attr", None) or getattr(part, "id", None) for part in ast.walk(call)}
            if not names & LOADERS:
                found.append("yaml.load without SafeLoader")
    return found


def sources() -> list[Path]:
    found = [path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py") if ".venv" not in path.parts]
    return sorted([*found, *ROOT.glob("*.py")])


def test_nothing_unpickles_or_evaluates():
    found = {str(path.relative_to(ROOT)): list(offences(path.read_text())) for path in sources()}
    assert len(found) > 100
    for name in WRITERS | PICKLES_OF_TESTS:
        assert found.pop(name) == [f"line {_line(name)}: import pickle"]
    assert {name: offence for name, offence in found.items() if offence} == {}


@pytest.mark.parametrize("name", sorted(WRITERS))
def test_what_may_write_pickles_reads_none(name: str):
    tree = ast.parse((ROOT / name).read_text())
    used = [node for node in ast.walk(tree) if isinstance(node, ast.Name) and node.id == "pickle"]
    written = [node for node in ast.walk(tree) if ast.unparse(node) == "pickle.dumps"]
    assert len(used) == len(written) > 0


def _line(name: str) -> int:
    """Line of the import of pickle."""
    return (ROOT / name).read_text().splitlines().index("import pickle") + 1


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
        "yaml.load(text, yaml.Loader)",
        "yaml.load(text)",
        "yaml.unsafe_load(text)",
        "pandas.read_pickle(path)",
        "importlib.import_module('pickle')",
    ],
)
def test_the_check_finds_it(source: str):
    assert list(offences(source))


@pytest.mark.parametrize(
    "source",
    [
        "torch.load(path, weights_only=True)",
        "re.compile(text)",
        "evaluate(x)",
        "yaml.load(text, Loader=yaml.SafeLoader)",
        "importlib.import_module(name)",
    ],
)
def test_the_check_lets_the_rest_be(source: str):
    assert not list(offences(source))

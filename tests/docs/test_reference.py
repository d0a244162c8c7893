"""The hand-written reference pages agree with the code."""

from __future__ import annotations

import ast
import inspect
import re
from pathlib import Path

import ibrobot_testing
import pytest

from ibrobot_core import hookspecs, interfaces
from ibrobot_core.descriptors import Late
from ibrobot_core.interfaces import guard

DOCS = Path(__file__).parents[2] / "docs"


def _signatures() -> dict[str, str]:
    functions = (node for node in ast.parse(inspect.getsource(hookspecs)).body if isinstance(node, ast.FunctionDef))
    found = {f.name: f"def {f.name}({ast.unparse(f.args)}) -> {ast.unparse(f.returns)}" for f in functions if f.returns}
    return {name: signature.replace("descriptors.", "") for name, signature in found.items()}


@pytest.mark.parametrize(("name", "signature"), _signatures().items())
def test_every_hook_is_documented_as_it_is(name: str, signature: str) -> None:
    assert f"### `{name}`\n\n```python\n{signature}\n```" in (DOCS / "reference/hooks.md").read_text()


def test_no_hook_is_documented_that_is_none() -> None:
    documented = re.findall(r"^### `(\w+)`", (DOCS / "reference/hooks.md").read_text(), re.MULTILINE)
    assert documented == list(_signatures())


def _row(name: str) -> list[str]:
    """The cells of a kind in the table of interfaces."""
    page = (DOCS / "reference/interfaces.md").read_text()
    return next(row for row in page.splitlines() if row.startswith(f"| `{name}`")).split("|")[1:-1]


def _misplaced(interface: type) -> list[str]:
    """The methods of an interface that its row does not list where they belong."""
    own = [key for key, value in vars(interface).items() if inspect.isfunction(value) and not key.startswith("_")]
    abstract = getattr(interface, "__abstractmethods__", ())
    must, might, done = (re.findall(r"`(\w+)`", cell) for cell in _row(interface.__name__)[1:4])
    own = [key for key in own if key not in {*done} - {*must, *might}]
    return [
        *set(must) ^ {key for key in own if key in abstract},
        *set(might) ^ {key for key in own if key not in abstract},
    ]


@pytest.mark.parametrize(
    "name",
    ["Hardware", "SimulatedHardware", "Sensor", "Teleop", "Policy", "Engine", "Executor", "Guard", "Transport",
     "Recorder", "EpisodeReader", "Viewer"],
)  # fmt: skip
def test_every_method_is_listed_where_it_belongs(name: str) -> None:
    interface = vars(interfaces).get(name) or vars(guard).get(name) or Late(f"ibrobot_core.api:{name}").load()
    assert _misplaced(interface) == []


@pytest.mark.integration
@pytest.mark.parametrize(
    "place",
    ["ibrobot_mujoco.scene:Scene", "ibrobot_planning.planner:Planner", "ibrobot_provenance.datasets:DatasetWriter",
     "ibrobot_provenance.jobs:Pool", "ibrobot_diagnose.cause:Cause"],
)  # fmt: skip
def test_every_method_of_kinds_of_plugins_is_listed_where_it_belongs(place: str) -> None:
    assert _misplaced(Late(place).load()) == []


def test_every_row_says_what_the_base_does() -> None:
    page = (DOCS / "reference/interfaces.md").read_text()
    rows = [row for row in page.splitlines() if row.startswith("| `")]
    assert len(rows) >= 17
    assert [row for row in rows if row.count("|") != 5 or not row.split("|")[4].strip()] == []


def test_every_suite_is_in_the_guide() -> None:
    page = (DOCS / "how-to/test-a-plugin.md").read_text()
    suites = [name for name in ibrobot_testing.__all__ if name.endswith("Suite") and name != "Suite"]
    assert [name for name in suites if f"`{name}`" not in page] == []


def test_readme_commands_are_the_first_two() -> None:
    readme = (DOCS.parent / "README.md").read_text()
    assert re.findall(r"^\$ (.*)$", readme, re.MULTILINE)[:2] == [
        "pip install uv && uv run ibrobot launch so101 --sim --headless --episodes 1",
        "uvx nox",
    ]
    assert "uvx nox" in (DOCS.parent / ".ci/run").read_text()

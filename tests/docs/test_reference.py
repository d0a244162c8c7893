"""The hand-written reference pages agree with the code."""

from __future__ import annotations

import ast
import inspect
import re
from pathlib import Path

import ibrobot_testing
import pytest

from ibrobot_core import api, hookspecs, interfaces

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


@pytest.mark.parametrize(
    "name",
    ["Hardware", "SimulatedHardware", "Sensor", "Teleop", "Policy", "Executor", "Transport",
     "Recorder", "Viewer"],
)  # fmt: skip
def test_every_method_is_listed_where_it_belongs(name: str) -> None:
    interface = getattr(interfaces, name, None) or getattr(api, name)
    own = [key for key, value in vars(interface).items() if inspect.isfunction(value) and not key.startswith("_")]
    row = next(r for r in (DOCS / "reference/interfaces.md").read_text().splitlines() if r.startswith(f"| `{name}`"))
    must, might = (re.findall(r"`(\w+)`", cell) for cell in row.split("|")[2:4])
    assert must == [key for key in own if key in interface.__abstractmethods__]
    assert might == [key for key in own if key not in interface.__abstractmethods__]


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

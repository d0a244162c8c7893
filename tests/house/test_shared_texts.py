"""A text that core and plugins share, e.g. the name of a topic, stands once: where core has a name for it."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

from ibrobot_core import api, app

ROOT = Path(__file__).parents[2]
NAMED = {
    value: name
    for floor in (api, app)
    for name in floor.__all__
    if isinstance(value := getattr(floor, name), str) and name.isupper()
}
"""Text -> its name on a floor of core's interface."""
OTHERS = {
    ("ibrobot_lerobot", "action"): "a feature of LeRobot's",
    ("ibrobot_mujoco", "action"): "a tensor of the policy's own",
    ("ibrobot_onnx", "action"): "an output of the graph",
    ("ibrobot_policy_servers", "action"): "a key of the servers' answers",
    ("ibrobot_serve", "action"): "a key of the answer to clients of GR00T",
}
"""Package and text that mean something else, and what."""


def constants(path: Path) -> Iterator[tuple[str, str]]:
    """The constants of a module, in capitals: name and text."""
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            yield from (
                (target.id, node.value.value)
                for target in node.targets
                if isinstance(target, ast.Name) and target.id.isupper()
            )


PACKAGES = sorted(path.parent for path in (ROOT / "plugins").glob("*/*ibrobot*/__init__.py"))


@pytest.mark.parametrize("package", PACKAGES, ids=lambda package: package.name)
def test_no_package_writes_again_what_core_names(package: Path) -> None:
    again = {
        f"{path.relative_to(package)}: {name} = {text!r} is {NAMED[text]} of core"
        for path in package.rglob("*.py")
        for name, text in constants(path)
        if text in NAMED and (package.name, text) not in OTHERS
    }
    assert not again

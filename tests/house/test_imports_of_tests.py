"""Plugins' tests import core as plugins do, through `api` and `app`, and helpers from `ibrobot_testing`."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

PLUGINS = Path(__file__).parents[2] / "plugins"
DRIVE = "the control core of a run in simulated time, with faults at chosen ticks"
LOOP = "a loop of a few lines with core's own smoother and safety layer, which plans of policies pass through"
ALLOWED = {
    (
        "ibrobot-plugin-lerobot/tests/test_compose.py",
        "ibrobot_core.contract.image",
    ): "every encoding that contracts know",
    ("ibrobot-plugin-lerobot-devices/tests/driving.py", "ibrobot_core.config"): DRIVE,
    ("ibrobot-plugin-lerobot-devices/tests/driving.py", "ibrobot_core.control.core"): DRIVE,
    ("ibrobot-plugin-lerobot-devices/tests/driving.py", "ibrobot_core.control.commands"): DRIVE,
    ("ibrobot-plugin-lerobot-devices/tests/driving.py", "ibrobot_core.interfaces.run_state"): DRIVE,
    ("ibrobot-plugin-lerobot-devices/tests/driving.py", "ibrobot_core.plugins"): DRIVE,
    ("ibrobot-plugin-diagnose/tests/test_causes.py", "ibrobot_core.plugins"): "plugins that are not installed",
    ("ibrobot-plugin-mujoco/tests/pick_loop.py", "ibrobot_core.control.safety"): LOOP,
    ("ibrobot-plugin-planning/tests/test_guard.py", "ibrobot_core.control.safety"): "what calls the guard",
    ("ibrobot-plugin-planning/tests/test_followers.py", "ibrobot_core.control.safety"): "what calls the guard",
    ("ibrobot-plugin-mujoco/tests/pick_loop.py", "ibrobot_core.dispatch.smoother"): LOOP,
    (
        "ibrobot-plugin-data/tests/test_interleavings.py",
        "ibrobot_core.interfaces.run_state",
    ): "plans beside other requests",
    ("ibrobot-plugin-data/tests/test_conversion_events.py", "ibrobot_core.events"): "a line as a command prints it",
    ("ibrobot-calibration/tests/test_joint_units.py", "ibrobot_core.plugins"): "an arm that no package offers",
    ("ibrobot-plugin-lerobot/tests/test_reader.py", "ibrobot_core.schema"): "pictures of a contract",
    ("ibrobot-plugin-lerobot/tests/test_compose.py", "ibrobot_core.schema"): "pictures of a contract",
    ("ibrobot-plugin-lerobot/tests/test_compose.py", "ibrobot_core.selection"): "selections of a contract",
    ("ibrobot-plugin-zenoh/tests/test_commands.py", "ibrobot_core.schema"): "a transport of another type",
    ("ibrobot-plugin-web/tests/test_ui_jobs.py", "ibrobot_core.events"): "a line as a command prints it",
}
"""File and module -> why its tests need it."""


def named_of_core(tree: ast.AST) -> Iterator[str]:
    """What a source text names of core: modules in imports, and dotted names in strings, as in programs and patches."""
    for node in ast.walk(tree):
        match node:
            case ast.Import(names=names):
                yield from (alias.name for alias in names if alias.name.split(".")[0] == "ibrobot_core")
            case ast.ImportFrom(module="ibrobot_core", names=names):
                yield from (f"ibrobot_core.{alias.name}" for alias in names)
            case ast.ImportFrom(module=str(module)) if module.startswith("ibrobot_core."):
                yield module
            case ast.Constant(value=str(text)):
                yield from re.findall(r"\bibrobot_core(?:\.\w+)+", text)


def may_name_internals(text: str) -> bool:
    """Whether a text may name more of core than its interface: parsing all files takes seconds."""
    return re.search(r"ibrobot_core(?!\.(?:api|app)\b)", text) is not None


def test_plugins_tests_use_the_public_interface() -> None:
    files = sorted(PLUGINS.glob("*/tests/**/*.py"))
    assert len(files) > 80
    found = {
        (str(path.relative_to(PLUGINS)), module)
        for path in files
        if may_name_internals(text := path.read_text(encoding="utf-8"))
        for module in named_of_core(ast.parse(text))
    }
    internals = {
        (path, module)
        for path, module in found
        if not f"{module}.".startswith(("ibrobot_core.api.", "ibrobot_core.app."))
    }
    assert sorted(internals - set(ALLOWED)) == []
    assert sorted(set(ALLOWED) - internals) == [], "allowed, but nowhere used"


@pytest.mark.parametrize(
    ("code", "name"),
    [
        ("import ibrobot_core.bus", "ibrobot_core.bus"),
        ("from ibrobot_core import messages", "ibrobot_core.messages"),
        ("def late():\n    from ibrobot_core.cli.main import main", "ibrobot_core.cli.main"),
        ("run('from ibrobot_core.clock import RealClock')", "ibrobot_core.clock"),
        ("patch('ibrobot_core.config.load', None)", "ibrobot_core.config.load"),
    ],
)
def test_the_check_finds_modules_of_core(code: str, name: str) -> None:
    assert list(named_of_core(ast.parse(code))) == [name]

"""The parts of a run see views of its session; only programs that run a robot make and see the session itself."""

from __future__ import annotations

import ast
from pathlib import Path

PLUGINS = Path(__file__).parents[2] / "plugins"
PROGRAMS = {
    "ibrobot_gym/environment.py",
    *(f"ibrobot_eval/{name}.py" for name in ("episodes", "film", "blinded")),
    "ibrobot_lerobot_program/run.py",
    "ibrobot_planning/commands/plan.py",
    "ibrobot_testing/section.py",
}
"""They make a session."""


def test_no_part_of_a_run_sees_its_session() -> None:
    for path in PLUGINS.glob("*/*ibrobot*/**/*.py"):
        names = {
            name.name
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
            if isinstance(node, ast.ImportFrom) and node.module == "ibrobot_core.app"
            for name in node.names
        }
        where = path.relative_to(PLUGINS).as_posix().partition("/")[2]
        assert "Session" not in names or where in PROGRAMS, f"{path}: take a RunView, or RunAccess"

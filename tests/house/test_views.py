"""The parts of a run see views of its session; only programs that run a robot make and see the session itself."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

import pytest

from ibrobot_core.interfaces import run

PLUGINS = Path(__file__).parents[2] / "plugins"
PROGRAMS = {
    "ibrobot_diagnose/live.py",
    "ibrobot_gym/environment.py",
    *(f"ibrobot_eval/{name}.py" for name in ("episodes", "film", "blinded")),
    "ibrobot_lerobot_program/run.py",
    "ibrobot_planning/commands/plan.py",
    "ibrobot_testing/section.py",
}
"""They make a session."""
MAY_MOVE = {
    "StreamingRun": {
        "ibrobot_gym/environment.py",
        "ibrobot_lerobot_program/run.py",
        *(f"ibrobot_testing/fakes/{name}.py" for name in ("host", "run")),
        *(f"ibrobot_data/{name}.py" for name in ("corrections", "handover", "replay_source")),
    },
    "GoalRun": {
        *(f"ibrobot_planning/execution/{name}.py" for name in ("motions", "source")),
        "ibrobot_ros/section.py",
        "ibrobot_ros2/goals.py",
        *(f"ibrobot_zenoh/{name}.py" for name in ("ros_sharing", "sharing")),
    },
    "GuardedRun": {"ibrobot_planning/execution/door.py"},
}
"""View that moves the robot -> the files that take it. A new file here is a new entrance to motion; see SENDERS."""
MOVES = {
    "StreamingRun": {"send_plan", "reset_episode", "end_episode", "raise_fault", "pass_on", "devices"},
    "GoalRun": {"send_goal", "cancel_goals"},
    "GuardedRun": {"send_goal", "cancel_goals", "goal_door"},
    "RecordedRun": {"operator_events", "begin_source", "end_source", "add_fault", "emit"},
}
"""View -> what it adds to `RunView`."""


@cache
def imported() -> list[tuple[str, set[str]]]:
    """Each file of the plugins, with the names that it imports from `ibrobot_core.app`."""
    found = []
    for path in PLUGINS.glob("*/*ibrobot*/**/*.py"):
        text = path.read_text(encoding="utf-8")
        names = {
            name.name
            for node in (ast.walk(ast.parse(text)) if "ibrobot_core.app" in text else ())
            if isinstance(node, ast.ImportFrom) and node.module == "ibrobot_core.app"
            for name in node.names
        }
        found.append((path.relative_to(PLUGINS).as_posix().partition("/")[2], names))
    return found


def members(view: str) -> set[str]:
    return set(getattr(run, view).__protocol_attrs__)


def test_no_part_of_a_run_sees_its_session() -> None:
    for where, names in imported():
        assert "Session" not in names or where in PROGRAMS, f"{where}: take a view of ibrobot_core.interfaces.run"


@pytest.mark.parametrize("view", MAY_MOVE)
def test_views_that_move_the_robot_are_taken_by_these_alone(view: str) -> None:
    assert {where for where, names in imported() if view in names} == MAY_MOVE[view]


@pytest.mark.parametrize("view", MOVES)
def test_each_view_adds_to_reading_what_it_is_for_and_nothing_else(view: str) -> None:
    assert members(view) - members("RunView") == MOVES[view]


def test_reader_of_a_run_has_no_way_to_control() -> None:
    assert members("RunView").isdisjoint(set().union(*MOVES.values()) | {"control", "command", "changing", "episodes"})
    returned = {
        each.fget.__annotations__["return"] for each in vars(run.RunView).values() if isinstance(each, property)
    }
    assert returned.isdisjoint({"ControlHost", "Session", "Any"})
    assert len(returned) > 15

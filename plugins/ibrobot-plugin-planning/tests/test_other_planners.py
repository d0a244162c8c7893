"""Planners of other plugins, in the manner of cuRobo and VAMP, fit the interface, the YAML, runs and commands."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, override

import attrs
import pytest
from click.testing import CliRunner
from ibrobot_planning import ibrobot_planners
from ibrobot_planning.client import LocalNode, MoveIt2
from ibrobot_planning.commands.plan import plan
from ibrobot_planning.execution.requests import GoTo
from ibrobot_planning.execution.source import GO_TO
from ibrobot_testing import PlannerSuite
from ibrobot_testing.site import made_up_site

from ibrobot_core.api import Context
from ibrobot_core.app import (
    ConfigError,
    LaunchRequest,
    PlanCode,
    Planner,
    Runtime,
    Session,
    installed_plugins,
    load_config,
)

from .other_planners import BatchOptions, BatchPlanner
from .table_arm import ARM, make_robot
from .test_motion import finish, robot_yaml


class TestBatchPlanner(PlannerSuite):
    @pytest.fixture(autouse=True)
    def _folder(self, tmp_path: Path) -> None:
        self.folder = tmp_path

    @override
    def context(self) -> Context:
        return attrs.evolve(super().context(), robot=make_robot(self.folder))

    @override
    def make(self, ctx: Context) -> Planner:
        return BatchPlanner(BatchOptions(), ctx)


def test_names_are_free():
    assert {"curobo", "vamp", "ompl", "roboplan"}.isdisjoint(each.type for each in ibrobot_planners())
    assert {"curobo", "vamp"}.isdisjoint(installed_plugins().types("planner"))


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[SimpleNamespace]:
    """Both planners are installed; a robot has a mode for each."""
    path = tmp_path / "robot.yaml"
    modes = "  curobo: {executors: [arm, gripper], planner: {type: curobo, batch: 2}}\n"
    modes += "  vamp: {executors: [arm, gripper], planner: {type: vamp}}\ndefault_control_mode"
    path.write_text(robot_yaml(tmp_path).replace("default_control_mode", modes) + "world: {}\n")
    with made_up_site(tmp_path / "site", Path(__file__).parent, monkeypatch) as site:
        site.add("parts", "parts.py")
        site.add("others", "other_planners.py")
        yield SimpleNamespace(yaml=path)


@pytest.fixture
def run(site: SimpleNamespace) -> Iterator[Callable[..., Runtime]]:
    made: list[Runtime] = []

    def started(mode: str) -> Runtime:
        registry = installed_plugins()
        config = load_config(site.yaml, mode=mode, sim=True, registry=registry)
        made.append(Runtime(Session(config, registry, LaunchRequest(lockstep=True))))
        made[-1].start()
        return made[-1]

    yield started
    for runtime in made:
        runtime.stop()


@pytest.mark.parametrize("mode", ["curobo", "vamp"])
def test_run_moves_with_it(run: Callable[..., Runtime], mode: str):
    runtime = run(mode)
    runtime.step()
    bus = runtime.session.bus
    for goal in ("left", "xyz=0.2,0.05,0.1 jaw=0.4", "pan=-0.3"):
        assert finish(runtime, bus.call(GO_TO, GoTo(goal))).success
    assert runtime.session.state is not None
    assert runtime.session.state.position[0] == pytest.approx(-0.3, abs=0.03)
    result = finish(runtime, bus.call("/planning/go_to", "xyz=2,0,0"))
    assert (result.outcome, result.code) == ("PLANNING_FAILED", PlanCode.NO_IK_SOLUTION)


def test_it_sees_the_world_of_the_run_and_serves_scripts(run: Callable[..., Runtime], caplog: Any):
    with LocalNode(run("curobo")) as node:
        node.wait(0.1)
        arm = MoveIt2(node, list(ARM), "base_link", "tip")
        arm.move_to_configuration([0.0] * 5)
        assert arm.wait_until_executed()
        trajectory = arm.plan(joint_positions=[1.0, 0.8, 0.8, 0.5, 0.0])
        assert trajectory is not None
        middle = arm.compute_fk(trajectory.points[len(trajectory.points) // 2].positions.tolist())
        arm.add_collision_sphere("ball", 0.03, pose=middle)
        assert arm.plan(joint_positions=[1.0, 0.8, 0.8, 0.5, 0.0]) is None
        assert "PLANNING_FAILED: every line to a goal touches a sphere" in caplog.text
        arm.remove_collision_object("ball")
        arm.move_to_pose(position=(0.2, 0.05, 0.1), cartesian=True)
        assert "UNRECOGNIZED_GOAL_TYPE: goals like LinearGoal are unknown" in caplog.text


def test_commands_take_it(site: SimpleNamespace):
    arguments = [str(site.yaml), "--sim", "--mode", "vamp", "--from", "up", "--goal", "left", "--json"]
    result = CliRunner().invoke(plan, arguments)
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert (found["planner"], found["success"]) == ("vamp", True)
    assert max(peak["share_of_limit"] for peak in found["peak_velocity"].values()) <= 1.01


def test_its_options_are_checked(site: SimpleNamespace):
    with pytest.raises(ConfigError, match=r"control_modes\.vamp\.planner\.bach: unknown key, did you mean 'batch'\?"):
        load_config(site.yaml, sim=True, overrides=("control_modes.vamp.planner.bach=3",), registry=installed_plugins())

"""Planners of other plugins, in the manner of cuRobo and VAMP, fit the interface, the YAML, runs and commands."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import override

import attrs
import pytest
from click.testing import CliRunner
from ibrobot_planning import ibrobot_planners
from ibrobot_planning.client import Client
from ibrobot_planning.execution.requests import GoTo
from ibrobot_planning.execution.source import GO_TO
from ibrobot_planning.planner import Planner
from ibrobot_planning.suite import PlannerSuite
from ibrobot_testing.command import command_line
from ibrobot_testing.site import made_up_site

from ibrobot_core.api import Context, PlanCode, PlanningError
from ibrobot_core.app import ConfigError, LaunchRequest, Runtime, Session, installed_plugins, load_config

from .other_planners import BatchOptions, BatchPlanner
from .table_arm import ARM, make_robot
from .test_motion import finish, robot_yaml

plan = command_line("plan")


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


def test_it_sees_the_world_of_the_run_and_serves_programs(run: Callable[..., Runtime]):
    client = Client.of_run(run("curobo"))
    client.wait(0.1)
    assert client.go_to({"joints": dict.fromkeys(ARM, 0.0)}).wait().success
    goal = {"joints": dict(zip(ARM, [1.0, 0.8, 0.8, 0.5, 0.0], strict=True))}
    trajectory = client.plan(goal)
    middle = trajectory.points[len(trajectory.points) // 2].positions.tolist()
    place = client.fk(dict(zip(ARM, middle, strict=True))).position
    ball = {"shape": "sphere", "radius": 0.03, "position": [place.x, place.y, place.z]}
    client.call("/world/add", {"name": "ball", "object": ball})
    with pytest.raises(PlanningError, match="every line to a goal touches a sphere") as refused:
        client.plan(goal)
    assert refused.value.code is PlanCode.PLANNING_FAILED
    client.call("/world/remove", "ball")
    with pytest.raises(PlanningError, match="goals like LinearGoal are unknown") as refused:
        client.plan_straight({"xyz": [0.2, 0.05, 0.1]})
    assert refused.value.code is PlanCode.UNRECOGNIZED_GOAL_TYPE


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

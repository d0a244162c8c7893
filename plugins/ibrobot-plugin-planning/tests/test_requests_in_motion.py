"""No request ends a run: all services of planning and of the world, with a motion under way."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from ibrobot_kinematics.clearance import CLEARANCE
from ibrobot_planning.execution.door import GoalDoor
from ibrobot_planning.execution.motions import Execution
from ibrobot_planning.execution.source import GO_TO, MOVE_TO_CONFIGURATION, MOVE_TO_POSE, RESULT
from ibrobot_planning.suite import FakePlanner
from ibrobot_planning.world.objects import SNAPSHOT, World

from ibrobot_core.api import HardwareError, IbrobotError, JointTrajectory, PlanCode, PlanningError
from ibrobot_core.app import ConfigError, RequestError, Runtime, Service

from .conftest import Make
from .table_arm import ARM, JOINTS
from .test_motion import assert_within_limits, command, finish, robot_yaml

WORLD = """world:
  objects:
    cup: {shape: sphere, radius: 0.03, position: [0, -0.8, 0.2]}
    net: {shape: sphere, radius: 0.03, position: [0, -0.9, 0.2], may_touch: [cup]}
"""
Run = Callable[..., Runtime]


@pytest.fixture
def run(start: Make, tmp_path: Path) -> Run:
    def started(world: str = WORLD, **asked: Any) -> Runtime:
        return start(text=robot_yaml(tmp_path) + world, **asked)

    return started


def moving(run: Run) -> tuple[Runtime, int]:
    """A run with a motion under way, and the number of its goal."""
    runtime = run()
    number = runtime.session.bus.call(GO_TO, "left")
    for _ in range(15):
        assert not runtime.step()
    return runtime, number


BAD_OBJECTS = {
    "unknown link": ("{name: a, object: {shape: sphere, radius: 0.01, link: foot}}", "object 'a': no link 'foot'"),
    "name of a link": ("{name: hand, object: {shape: sphere, radius: 0.01}}", "an object has the name of link 'hand'"),
    "name of the arm's world": ("{name: world, object: {shape: plane}}", "an object has the name of link 'world'"),
    "touches nothing known": (
        "{name: a, object: {shape: sphere, radius: 0.01, may_touch: [foot]}}",
        "object 'a' may touch 'foot', which is neither a link nor an object",
    ),
    "replaced by a bad one": (
        "{name: cup, replace: true, object: {shape: sphere, radius: 0.01, link: foot}}",
        "object 'cup': no link 'foot'",
    ),
    "far away": ("{name: a, object: {shape: sphere, radius: 0.01, position: [1.0e+308, 0, 0]}}", "from -1000 to 1000"),
}


@pytest.mark.parametrize(("request_", "told"), BAD_OBJECTS.values(), ids=BAD_OBJECTS)
def test_bad_object_is_refused_and_the_motion_goes_on(run: Run, request_: str, told: str):
    runtime, number = moving(run)
    before = runtime.session.bus.call(SNAPSHOT, None)
    with pytest.raises((PlanningError, RequestError), match=told):
        runtime.session.bus.call("/world/add", yaml.safe_load(request_))
    assert runtime.session.bus.call(SNAPSHOT, None) == before
    assert finish(runtime, number).success
    assert finish(runtime, runtime.session.bus.call(GO_TO, "up")).success


@pytest.mark.parametrize(
    ("service", "request_", "told"),
    [
        ("/world/allow", "{name: cup, may_touch: [foot]}", "object 'cup' may touch 'foot'"),
        ("/world/attach", "{name: cup, may_touch: [foot]}", "object 'cup' may touch 'foot'"),
        ("/world/move", "{name: cup, position: [0, -1.0e+300, 0]}", "from -1000 to 1000"),
    ],
)
def test_bad_change_is_refused(run: Run, service: str, request_: str, told: str):
    runtime = run()
    with pytest.raises((PlanningError, RequestError), match=told):
        runtime.session.bus.call(service, yaml.safe_load(request_))
    assert finish(runtime, runtime.session.bus.call(GO_TO, "left")).success


def test_object_that_another_may_touch_can_be_removed(run: Run):
    runtime = run()
    runtime.session.bus.call("/world/remove", {"name": "cup"})
    assert runtime.session.bus.call(SNAPSHOT, None).objects["net"].may_touch == frozenset()
    assert finish(runtime, runtime.session.bus.call(GO_TO, "left")).success


@pytest.mark.parametrize("name", ["hand", "net"])
def test_bad_object_of_the_yaml_is_refused_before_the_start(run: Run, name: str):
    object_ = (
        f"{name}: {{shape: sphere, radius: 0.01, position: [0, 1, 0], link: {'null' if name == 'hand' else 'foot'}}}"
    )
    with pytest.raises(ConfigError, match=r"objects\.hand: a link of arm\.xml has this name|unknown link 'foot'"):
        run(world=f"world: {{objects: {{{object_}}}}}")


def test_object_may_touch_the_floor_and_clouds_that_come_and_go(run: Run):
    runtime = run(
        world="world: {objects: {cup: {shape: sphere, radius: 0.01, position: [0, -1, 0], may_touch: [floor, top]}},"
        " clouds: {top: {topic: /top/points}}}\n"
    )
    runtime.session.bus.call("/world/attach", {"name": "cup"})
    assert finish(runtime, runtime.session.bus.call(GO_TO, "pan=0.2")).code is not PlanCode.INVALID_LINK_NAME


def test_motion_that_cannot_be_checked_stops(run: Run, monkeypatch: pytest.MonkeyPatch):
    def blocked(self: GoalDoor, trajectory: JointTrajectory, from_ns: int = 0) -> str:
        raise PlanningError("the world makes no sense")

    runtime, number = moving(run)
    monkeypatch.setattr(GoalDoor, "blocked", blocked)
    result = finish(runtime, number)
    assert result.code is PlanCode.MOTION_PLAN_INVALIDATED_BY_ENVIRONMENT_CHANGE
    assert "the motion cannot be checked: the world makes no sense" in result.message


def test_goal_whose_motion_is_refused_when_it_blends_fails_alone(run: Run, monkeypatch: pytest.MonkeyPatch):
    """For example by an emergency stop at that moment."""
    runtime, number = moving(run)

    def follow(self: Execution, goals: Any, *, blends: bool) -> None:
        raise HardwareError("refused, the robot is stopping")

    with monkeypatch.context() as patch:
        patch.setattr(Execution, "follow", follow)
        result = finish(runtime, runtime.session.bus.call(GO_TO, "right"))
    assert (result.outcome, result.message) == ("EXECUTION_FAILED", "refused, the robot is stopping")
    ended = runtime.session.bus.call(RESULT, number)
    assert ended is not None
    assert ended.outcome == "CANCELLED"
    assert finish(runtime, runtime.session.bus.call(GO_TO, "up")).success


@pytest.mark.parametrize(("constraint", "blends"), [("", True), (" region=-1,-1,-1,1,1,1", False)])
def test_motion_with_constraints_begins_once_the_arm_rests(run: Run, constraint: str, blends: bool):
    """A blend would leave the path that was checked for them."""
    runtime, _ = moving(run)
    number = runtime.session.bus.call(GO_TO, f"right{constraint}")
    commands = [command(runtime)]
    while (result := runtime.session.bus.call(RESULT, number)) is None:
        assert not runtime.step()
        commands.append(command(runtime))
    assert result.success, result
    moves = np.flatnonzero(np.abs(np.diff(commands, axis=0)).max(axis=1) > 1e-6)
    assert (len(moves) == moves[-1] - moves[0] + 1) == blends


def test_bug_of_a_planner_fails_its_goal_alone(start: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    runtime = start(text=robot_yaml(tmp_path).replace("type: rrt_connect", "type: cubic"))
    with monkeypatch.context() as patch:
        patch.setattr(FakePlanner, "plan", lambda self, request: 1 / 0)
        result = finish(runtime, runtime.session.bus.call(GO_TO, "pan=0.1"))
    assert (result.outcome, result.code) == ("PLANNING_FAILED", PlanCode.FAILURE)
    assert result.message == "the planner failed: ZeroDivisionError: division by zero"
    assert finish(runtime, runtime.session.bus.call(GO_TO, "pan=0.1")).success


NUMBERS = st.one_of(
    st.sampled_from([0, 1, -1, 0.5, 1e-300, 1e-5, 1e5, 1e155, 1e308, -1e308, 10**400, np.inf, -np.inf, np.nan, True]),
    st.floats(-2, 2),
)
NAMES = st.sampled_from(
    [*JOINTS, "hand", "world", "cup", "net", "a", "foot", "", "left", "up", "~", "${HOME}", "x" * 300]
)
THREE = st.lists(NUMBERS, min_size=2, max_size=4)
JOINT_VALUES = st.dictionaries(NAMES, NUMBERS, max_size=4)
WILD = st.recursive(
    st.one_of(st.none(), NUMBERS, NAMES),
    lambda each: st.lists(each, max_size=3) | st.dictionaries(NAMES, each, max_size=3),
    max_leaves=6,
)


def some(**keys: st.SearchStrategy[Any]) -> st.SearchStrategy[dict[str, Any]]:
    """Mappings with some of the keys, now and then with a wild value."""
    return st.fixed_dictionaries(
        {}, optional={key: st.one_of(value, value, value, WILD) for key, value in keys.items()}
    )


POLICIES = st.sampled_from(["refuse", "nearest", "keep_axis", "arm_plane", "current", "free", "no"])
SIX = st.lists(NUMBERS, min_size=5, max_size=7)
AXIS = st.one_of(st.sampled_from(["x", "-z", "up"]), THREE)
CONSTRAINTS = some(
    upright=NUMBERS, upright_axis=AXIS, region=SIX, view=THREE, view_angle=NUMBERS, view_axis=AXIS, view_from=THREE
)
GOAL = some(
    pose=NAMES,
    joints=JOINT_VALUES,
    xyz=THREE,
    axis=THREE,
    rpy=THREE,
    quaternion=st.lists(NUMBERS, max_size=4),
    joint_tolerance=NUMBERS,
    position_tolerance=NUMBERS,
    angle_tolerance=NUMBERS,
    beyond_reach=POLICIES,
    path_constraints=CONSTRAINTS,
)
KEPT = st.one_of(
    st.fixed_dictionaries({"upright": st.floats(0.01, 3)}),
    st.fixed_dictionaries({"region": st.just([-1, -1, -1, 1, 1, 1])}, optional={"upright": st.floats(0.01, 3)}),
    st.fixed_dictionaries({"view": st.lists(st.floats(-2, 2), min_size=3, max_size=3)}, optional={"view_axis": AXIS}),
)
TOOL = st.fixed_dictionaries(
    {"xyz": st.tuples(NUMBERS, NUMBERS, NUMBERS).map(list)},
    optional={"axis": THREE, "path_constraints": st.one_of(KEPT, KEPT, CONSTRAINTS)},
)
GOALS = st.one_of(GOAL, TOOL)
SCALINGS = {"velocity_scaling": NUMBERS, "acceleration_scaling": NUMBERS}
OBJECT = some(
    shape=st.sampled_from(["box", "sphere", "cylinder", "capsule", "plane", "mesh"]),
    size=THREE,
    radius=NUMBERS,
    height=NUMBERS,
    position=THREE,
    rpy=THREE,
    link=NAMES,
    may_touch=st.lists(NAMES, max_size=2),
    file=NAMES,
)
SPHERE = st.fixed_dictionaries(
    {"shape": st.just("sphere"), "radius": NUMBERS, "position": THREE}, optional={"link": NAMES, "rpy": THREE}
)
POINT = st.fixed_dictionaries(
    {"time_from_start_ns": st.integers(-(10**9), 10**10), "positions": st.lists(NUMBERS, min_size=5, max_size=5)},
    optional={"velocities": st.lists(NUMBERS, min_size=4, max_size=5)},
)
WORDS = st.sampled_from(
    [
        "xyz=1e308,0,0", "xyz=0.2,0,0.1 axis=1e300,0,0", "pan=0.2", "left", "xyz=0.2,0.05,0.1", "rpy=1",
        "left upright=2.5", "pan=0.1 region=-1,-1,-1,1,1,1", "xyz=0.2,0,0.1 view=0,0,0 view_angle=3",
        "up upright=1e-300",
    ]
)  # fmt: skip
POSE = some(
    position=some(x=NUMBERS, y=NUMBERS, z=NUMBERS), orientation=some(x=NUMBERS, y=NUMBERS, z=NUMBERS, w=NUMBERS)
)
REQUESTS: dict[Service[Any, Any] | str, st.SearchStrategy[Any]] = {
    GO_TO: WORDS,
    RESULT: some(number=NUMBERS),
    "/move_action": some(goals=st.lists(GOALS, max_size=2), **SCALINGS),
    "/execute_trajectory": some(joint_names=st.just(list(ARM)), points=st.lists(POINT, max_size=3)),
    "/compute_ik": some(goal=GOALS, start=JOINT_VALUES, avoid_collisions=st.booleans()),
    "/compute_fk": some(joints=JOINT_VALUES, links=st.lists(NAMES, max_size=2)),
    "/plan_kinematic_path": some(goals=st.lists(GOALS, max_size=2), start=JOINT_VALUES, **SCALINGS),
    "/compute_cartesian_path": some(
        waypoints=st.lists(GOALS, max_size=2),
        least_fraction=NUMBERS,
        start=JOINT_VALUES,
        path_constraints=CONSTRAINTS,
        **SCALINGS,
    ),
    "/planning/plan": WORDS,
    "/get_planning_scene": st.none(),
    MOVE_TO_POSE: some(target_pose=POSE, velocity_scaling=NUMBERS),
    MOVE_TO_CONFIGURATION: some(
        target_joint_state=some(name=st.lists(NAMES, max_size=2), position=st.lists(NUMBERS, max_size=2))
    ),
    "/world/add": some(name=NAMES, object=st.one_of(OBJECT, SPHERE), replace=st.booleans()),
    "/world/remove": some(name=NAMES),
    "/world/move": some(name=NAMES, position=THREE, rpy=THREE),
    "/world/attach": some(name=NAMES, link=NAMES, may_touch=st.lists(NAMES, max_size=2)),
    "/world/detach": some(name=NAMES, may_touch=st.lists(NAMES, max_size=2)),
    "/world/allow": some(name=NAMES, may_touch=st.lists(NAMES, max_size=2)),
    "/world/touch": some(objects=st.lists(NAMES, max_size=2)),
    CLEARANCE: some(positions=JOINT_VALUES),
}
ONE = st.sampled_from(list(REQUESTS)).flatmap(
    lambda name: st.tuples(st.just(name), st.one_of(*[REQUESTS[name]] * 5, WILD))
)


@pytest.mark.parametrize("examples", [100, pytest.param(400, marks=pytest.mark.long)])
def test_no_request_ends_a_run(run: Run, caplog: pytest.LogCaptureFixture, examples: int):
    runtime = run()
    bus, commands = runtime.session.bus, [command(runtime)]

    @settings(max_examples=examples, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
    @given(asked=ONE, away=st.booleans())
    def check(asked: tuple[Service[Any, Any] | str, Any], away: bool) -> None:
        caplog.clear()
        service, request = asked
        bus.call(GO_TO, "pan=1.2" if away else "pan=-1.2")
        for number in range(6):
            if number == 3:
                with contextlib.suppress(IbrobotError):
                    bus.call(service, request)
            assert not runtime.step(), "the run goes on"
            commands.append(command(runtime))
        assert not runtime.session.faults
        assert not [line for line in caplog.messages if "bug" in line or "the planner failed" in line]
        world = bus.call(SNAPSHOT, None)
        assert isinstance(world, World)
        for name in set(world.objects) - {"cup", "net"}:
            bus.call("/world/remove", {"name": name})

    check()
    for _ in range(300):
        runtime.step()
        commands.append(command(runtime))
    assert_within_limits(runtime, commands)

"""Programs that move a robot in lockstep by `ibrobot_planning.client`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from ibrobot_planning.client import Client

from ibrobot_core.api import PlanCode, PlanningError
from ibrobot_core.app import Runtime

from .conftest import Make
from .table_arm import ARM
from .test_motion import robot_yaml
from .test_world import STL

LEFT = dict(zip(ARM, [1.0, 0.8, 0.8, 0.5, 0.0], strict=True))
GOAL = {"xyz": [0.2, 0.05, 0.1]}


@pytest.fixture
def run(start: Make, tmp_path: Path) -> Callable[..., Runtime]:
    def started(*overrides: str, **asked: Any) -> Runtime:
        return start(*overrides, text=robot_yaml(tmp_path) + f"world: {{meshes: {tmp_path}}}\n", **asked)

    return started


@pytest.fixture
def robot(run: Callable[..., Runtime]) -> Iterator[SimpleNamespace]:
    """A robot in lockstep, its client, and a list of what to do at each step."""
    at_step: list[Callable[[], object]] = []
    runtime = run()

    def stepped() -> None:
        for act in at_step:
            act()

    with Client.of_run(runtime, stepped) as client:
        client.wait(0.1)
        yield SimpleNamespace(runtime=runtime, client=client, at_step=at_step)


def test_motions_by_text_and_by_keys(robot: SimpleNamespace):
    client: Client = robot.client
    result = client.go_to({"joints": LEFT}, velocity_scaling=0.9).wait()
    assert (result.success, result.outcome, result.code) == (True, "SUCCEEDED", PlanCode.SUCCESS)
    assert [client.joints()[name] for name in ARM] == pytest.approx(list(LEFT.values()), abs=0.03)
    for position in (0.5, 0.0, 0.2):
        assert client.go_to(f"jaw={position}").wait().success
        assert client.joints()["jaw"] == pytest.approx(position, abs=0.03)
    assert client.go_to("lift=0.3,pan=-0.2").wait().success
    assert [client.joints()[name] for name in ("pan", "lift")] == pytest.approx([-0.2, 0.3], abs=0.03)


def test_kinematics_agree(robot: SimpleNamespace):
    pose = robot.client.fk(LEFT)
    place, turn = pose.position, pose.orientation
    goal = {"xyz": [place.x, place.y, place.z], "quaternion": [turn.x, turn.y, turn.z, turn.w]}
    again = robot.client.fk(robot.client.ik(goal)).position
    assert (again.x, again.y, again.z) == pytest.approx((place.x, place.y, place.z), abs=1e-3)
    hand = robot.client.fk(LEFT, "hand").position
    between = [getattr(place, name) - getattr(hand, name) for name in "xyz"]
    assert np.linalg.norm(between) == pytest.approx(0.06, abs=1e-6), "the tip is 60 mm ahead of the hand"
    assert robot.client.fk() == robot.client.fk(robot.client.joints())


def test_orientation_that_five_joints_cannot_take(robot: SimpleNamespace):
    sideways = {"xyz": [0.2, 0.1, 0.2], "quaternion": [0.5, 0.5, 0.5, 0.5]}
    with pytest.raises(PlanningError, match="tip cannot take this orientation") as refused:
        robot.client.ik({**sideways, "beyond_reach": "refuse"})
    assert refused.value.code is PlanCode.NO_IK_SOLUTION
    assert robot.client.ik({**sideways, "beyond_reach": "free"})
    assert robot.client.ik({"xyz": sideways["xyz"]}), "a position alone"


def test_plan_is_followed(robot: SimpleNamespace):
    plan = robot.client.plan(GOAL, velocity_scaling=0.5, acceleration_scaling=0.5)
    assert plan.joint_names == ARM
    assert robot.client.follow(plan).wait().success
    reached = [robot.client.joints()[name] for name in ARM]
    assert reached == pytest.approx(plan.points[-1].positions.tolist(), abs=0.03)
    still = dict.fromkeys(ARM, 0.0)
    fast = robot.client.plan({"joints": LEFT}, start=still)
    slow = robot.client.plan({"joints": LEFT}, start=still, velocity_scaling=0.2)
    assert slow.points[-1].time_from_start_ns > 2 * fast.points[-1].time_from_start_ns
    by_text = robot.client.plan("pan=1,lift=0.8,elbow=0.8,flex=0.5,roll=0", start=still)
    assert by_text.points[-1].positions.tolist() == fast.points[-1].positions.tolist()


def test_plan_from_elsewhere_is_not_followed(robot: SimpleNamespace):
    plan = robot.client.plan({"joints": LEFT}, start={"pan": 1.5})
    result = robot.client.follow(plan).wait()
    assert (result.success, result.code) == (False, PlanCode.START_STATE_INVALID)
    assert "the trajectory begins with pan at " in result.message
    assert "at most 0.01 rad may lie between them" in result.message


def test_straight_line(robot: SimpleNamespace):
    assert robot.client.go_to({"xyz": [0.2, 0.0, 0.12]}).wait().success
    heights: list[float] = []
    robot.at_step.append(lambda: heights.append(robot.client.fk().position.z))
    line = robot.client.plan_straight({"xyz": [0.2, 0.06, 0.12]}, least_fraction=0.9)
    assert robot.client.follow(line).wait().success
    assert np.ptp(heights) < 0.015
    assert robot.client.fk().position.y == pytest.approx(0.06, abs=0.01)


def test_alternatives(robot: SimpleNamespace):
    result = robot.client.go_to({"xyz": [3.0, 0.0, 0.0]}, {"joints": {"pan": 0.4}}).wait()
    assert (result.success, result.alternative) == (True, 1)
    assert robot.client.joints()["pan"] == pytest.approx(0.4, abs=0.03)


def test_cancel_holds_and_a_new_motion_replaces(robot: SimpleNamespace):
    motion = robot.client.go_to({"joints": LEFT})
    robot.client.wait(0.3)
    assert motion.result() is None
    robot.client.cancel()
    assert (motion.wait().outcome, motion.wait().code) == ("CANCELLED", PlanCode.PREEMPTED)
    motion = robot.client.go_to({"joints": LEFT})
    robot.client.wait(0.2)
    assert robot.client.go_to("pan=-0.3,lift=0,elbow=0,flex=0,roll=0").wait().success
    assert not motion.wait().success
    assert robot.client.joints()["pan"] == pytest.approx(-0.3, abs=0.03)


def test_world(robot: SimpleNamespace, tmp_path: Path):
    mesh = tmp_path / "part.stl"
    mesh.write_text(STL)
    client: Client = robot.client
    shapes: dict[str, dict[str, Any]] = {
        "table": {"shape": "box", "size": [0.6, 0.6, 0.02], "position": [0, 0, -0.05]},
        "ball": {"shape": "sphere", "radius": 0.02, "position": [0.25, 0.1, 0.1]},
        "can": {"shape": "cylinder", "height": 0.1, "radius": 0.03, "position": [0, 0.35, 0.05], "rpy": [np.pi, 0, 0]},
        "part": {"shape": "mesh", "file": str(mesh), "scale": 0.001, "position": [0, -0.3, 0.1]},
    }
    for name, shape in shapes.items():
        client.call("/world/add", {"name": name, "object": shape})
    objects = client.call("/get_planning_scene")["objects"]
    assert {name: each["shape"] for name, each in objects.items()} == {
        name: each["shape"] for name, each in shapes.items()
    }
    assert abs(objects["can"]["pose"]["orientation"]["x"]) == pytest.approx(1.0)
    client.call("/world/move", {"name": "ball", "position": [0, 0, 0.55]})
    client.call("/world/attach", {"name": "ball", "may_touch": ["finger"]})
    ball = client.call("/get_planning_scene")["objects"]["ball"]
    assert (ball["link"], ball["may_touch"]) == ("hand", ["finger", "hand"])
    client.call("/world/detach", {"name": "ball"})
    client.call("/world/allow", {"name": "can", "may_touch": ["table", "ball", "hand"]})
    assert client.call("/get_planning_scene")["objects"]["can"]["may_touch"] == ["ball", "hand", "table"]
    for name in shapes:
        client.call("/world/remove", name)
    assert client.call("/get_planning_scene")["objects"] == {}


def test_object_in_the_way(robot: SimpleNamespace):
    assert robot.client.ik(GOAL)
    block = {"shape": "box", "size": [0.1, 0.1, 0.1], "position": GOAL["xyz"]}
    robot.client.call("/world/add", {"name": "block", "object": block})
    with pytest.raises(PlanningError, match="each of its configurations touches something"):
        robot.client.ik(GOAL)
    assert robot.client.go_to(GOAL).wait().code is PlanCode.GOAL_IN_COLLISION
    links = robot.client.call("/get_planning_scene")["links"]
    robot.client.call("/world/allow", {"name": "block", "may_touch": links})
    assert robot.client.go_to(GOAL).wait().success


REFUSED: list[tuple[Callable[[Client], Any], str]] = [
    (lambda client: client.go_to("xyz=0.2,0.1"), "xyz"),
    (lambda client: client.go_to({"xyz": [0.2, 0.1]}), r"goals\.0\.xyz: expected a list of 3 values, got 2"),
    (lambda client: client.go_to({"quaternion": [1, 0, 0, 0]}), "a goal has one of pose, joints, xyz or object"),
    (lambda client: client.go_to(), "a request needs at least one goal"),
    (lambda client: client.go_to("home", {"pose": "home"}), r"goals\.0: expected a mapping, got 'home'"),
    (lambda client: client.go_to("pan=1", velocity_scaling=0.5), "velocity_scaling: unknown key"),
    (lambda client: client.go_to("tilt=0.1"), "no joint 'tilt'"),
    (lambda client: client.plan({"joints": {"tilt": 0.1}}), "no joint 'tilt'; the joints are: pan"),
    (lambda client: client.plan({**GOAL, "quaternion": [0, 0, 0, 2]}), "quaternion has length"),
    (lambda client: client.fk(link="cup"), "cup"),
    (lambda client: client.call("/world/remove", "cup"), "no object 'cup'; the objects are: none"),
    (lambda client: client.call("/world/attach", {"name": "cup"}), "no object 'cup'"),
    (lambda client: client.call("/wave"), "nobody serves /wave; served: "),
]


def test_wrong_calls(robot: SimpleNamespace):
    for call, message in REFUSED:
        with pytest.raises(PlanningError, match=message):
            call(robot.client)


def test_mode_without_a_planner_has_no_services(run: Callable[..., Runtime]):
    with pytest.raises(PlanningError, match="nobody serves /get_planning_scene"):
        Client.of_run(run(mode="idle")).joints()

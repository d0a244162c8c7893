"""The section `world`: objects from the YAML, and services that change them."""

from __future__ import annotations

import json
import logging
import threading
from pathlib import Path
from typing import Any, override

import attrs
import numpy as np
import pytest
from ibrobot_kinematics.clearance import CLEARANCE
from ibrobot_kinematics.poses import matrix
from ibrobot_planning.planner import JointGoal, PlanRequest
from ibrobot_planning.planners.options import RrtConnectOptions
from ibrobot_planning.planners.rrt import RrtConnectPlanner
from ibrobot_planning.world.objects import SNAPSHOT, Box, Capsule, Cylinder, Mesh, Plane, Sphere, read_mesh
from ibrobot_planning.world.options import WorldOptions
from ibrobot_planning.world.section import (
    ADD,
    ATTACH,
    DETACH,
    LARGEST_MESH,
    MOST_OBJECTS,
    REMOVE,
    SHAPES,
    TOUCH,
    WorldKeeper,
    first_world,
)
from ibrobot_testing import SectionSuite, make_session

from ibrobot_core.api import Context, Float64MultiArray, PlanningError, Pose, SceneObject, SteppedClock
from ibrobot_core.app import ConfigError, RequestError, single_options

from .parts import POSES
from .table_arm import ARM, make_robot
from .test_motion import robot_yaml
from .test_world import STL

YAML = """
objects:
  table: {shape: box, size: [0.6, 0.8, 0.02], position: [0.3, 0, -0.02]}
  can: {shape: cylinder, radius: 0.03, height: 0.1, position: [0.3, 0.1, 0.05], may_touch: [table]}
  ball: {shape: sphere, radius: 0.02, position: [0.1, 0, 0.6]}
  pen: {shape: capsule, radius: 0.005, height: 0.1, rpy: [0, 1.5708, 0], position: [0.3, -0.2, 0.3]}
  wall: {shape: plane, rpy: [0, 1.5708, 0], position: [-0.5, 0, 0]}
"""


def options(text: str = YAML) -> WorldOptions:
    return single_options(WorldOptions, (), "world", text=text)


SIDES = {"left_": (0.0, 0.3, 0.0, 0.0), "right_": (0.0, -0.3, 0.0, 0.0)}


class TestWorldKeeper(SectionSuite):
    @override
    def component(self, session):
        return WorldKeeper(options(), session)


@pytest.fixture
def run(tmp_path, monkeypatch):
    """A session with the world, of the arm at zero."""
    session = make_session(robot=make_robot(tmp_path))
    reading = type("Reading", (), {"position": np.zeros(6)})()
    monkeypatch.setattr(session, "measured", lambda: reading)
    keeper = WorldKeeper(options(), session)
    keeper.start()
    yield session.bus
    keeper.stop()


def test_shapes_are_those_of_objects_in_the_base_frame(run) -> None:
    run.call(ATTACH, {"name": "ball", "link": "hand"})
    shapes = {each.name: (each.shape, each.size) for each in run.call(SHAPES)}
    assert shapes == {
        "table": ("box", (0.6, 0.8, 0.02)),
        "can": ("cylinder", (0.03, 0.1)),
        "pen": ("capsule", (0.005, 0.1)),
        "wall": ("plane", ()),
    }


@pytest.fixture
def both(tmp_path, monkeypatch):
    """A session with the world, of two arms at zero."""
    robot = make_robot(tmp_path)
    joints = [attrs.evolve(each, name=f"{side}{each.name}") for side in SIDES for each in robot.joints]
    described = attrs.evolve(robot.description, arms=SIDES, poses={})
    session = make_session(robot=attrs.evolve(robot, joints=tuple(joints), groups={}, description=described))
    reading = type("Reading", (), {"position": np.zeros(12)})()
    monkeypatch.setattr(session, "measured", lambda: reading)
    keeper = WorldKeeper(options(), session)
    keeper.start()
    yield session.bus
    keeper.stop()


def test_the_hands_of_both_arms_may_touch_named_objects_and_what_each_carries(both) -> None:
    both.call(ATTACH, {"name": "ball", "link": "right_hand"})
    both.call(TOUCH, {"objects": ["can"]})
    hands = {f"{side}{link}" for side in SIDES for link in ("hand", "finger")}
    assert both.call(SNAPSHOT).objects["can"].may_touch == {"table", "ball"} | hands
    both.call(TOUCH, {"objects": []})
    assert both.call(SNAPSHOT).objects["can"].may_touch == {"table"}


def test_which_of_two_hands_carries_an_object_has_to_be_said(both) -> None:
    with pytest.raises(PlanningError, match=r"attach 'ball': say which link carries it, .* several hands.*left_hand"):
        both.call(ATTACH, {"name": "ball"})


def test_no_object_is_put_down_farther_away_than_objects_may_be(run) -> None:
    run.call(ATTACH, {"name": "ball", "link": "hand"})
    run.call("/world/move", {"name": "ball", "position": [1000, 1000, 1000], "rpy": [0.5, 0.5, 0.5]})
    with pytest.raises(PlanningError, match="1000 m away"):
        run.call(DETACH, {"name": "ball"})
    assert run.call(SNAPSHOT).objects["ball"].link == "hand"


def test_what_gets_the_name_of_a_removed_object_may_not_be_touched(run) -> None:
    thing = {"shape": "box", "size": [0.1, 0.1, 0.1]}
    run.call(TOUCH, {"objects": ["can", "ball"]})
    run.call(ADD, {"name": "can", "object": thing, "replace": True})
    assert "hand" in run.call(SNAPSHOT).objects["can"].may_touch, "it is still what the hand grasps"
    run.call(REMOVE, {"name": "can"})
    run.call(ADD, {"name": "can", "object": thing})
    objects = run.call(SNAPSHOT).objects
    assert objects["can"].may_touch == frozenset()
    assert "hand" in objects["ball"].may_touch


def test_objects_come_from_the_yaml(run):
    objects = run.call(SNAPSHOT, None).objects
    assert {name: type(thing.shape) for name, thing in objects.items()} == {
        "table": Box,
        "can": Cylinder,
        "ball": Sphere,
        "pen": Capsule,
        "wall": Plane,
    }
    assert objects["can"].may_touch == {"table"}
    np.testing.assert_allclose(matrix(objects["pen"].pose)[:3, 2], [1, 0, 0], atol=1e-5)


def test_services_change_the_world_and_leave_snapshots_alone(run):
    before = run.call(SNAPSHOT, None)
    names = run.call("/world/add", {"name": "post", "object": {"shape": "box", "size": [0.1, 0.1, 0.4]}})
    assert names == ["table", "can", "ball", "pen", "wall", "post"]
    assert "post" not in before.objects
    run.call("/world/move", {"name": "post", "position": [0.2, 0.3, 0.2]})
    assert run.call(SNAPSHOT, None).objects["post"].pose.position.y == 0.3
    assert "post" not in run.call("/world/remove", {"name": "post"})


def test_attached_objects_stay_where_they_are(run):
    before = matrix(run.call(SNAPSHOT, None).objects["ball"].pose)
    run.call("/world/attach", {"name": "ball", "link": "hand", "may_touch": ["finger"]})
    held = run.call(SNAPSHOT, None).objects["ball"]
    assert (held.link, held.may_touch) == ("hand", {"hand", "finger"})
    # The hand is 0.41 m above the base.
    np.testing.assert_allclose(matrix(held.pose)[:3, 3], [0.1, 0, 0.19], atol=1e-9)
    run.call("/world/detach", {"name": "ball"})
    put = run.call(SNAPSHOT, None).objects["ball"]
    assert put.link is None
    np.testing.assert_allclose(matrix(put.pose), before, atol=1e-9)


def test_planners_use_the_world_of_the_run(run, tmp_path):
    context = Context("planner", SteppedClock(0), logging.getLogger("test"), make_robot(tmp_path), bus=run)
    planner = RrtConnectPlanner(RrtConnectOptions(), context)
    planner.load()
    goal = JointGoal(ARM, np.array([0.3, 1.45, 0.0, 0.0, 0.0]))
    planner.plan(PlanRequest(ARM, np.zeros(5), goal))
    run.call(
        "/world/add",
        {"name": "block", "object": {"shape": "box", "size": [0.4, 0.4, 0.1], "position": [0.3, 0.1, 0.1]}},
    )
    with pytest.raises(PlanningError, match=r"the goal is in collision: \w+ overlaps block"):
        planner.plan(PlanRequest(ARM, np.zeros(5), goal))


def test_clearance_is_the_distance_from_the_nearest_object(run):
    upright = run.call(CLEARANCE, {"positions": {"pan": 0.0}})
    assert run.call(CLEARANCE, {}) == pytest.approx(upright)
    run.call(
        "/world/add", {"name": "above", "object": {"shape": "box", "size": [0.1, 0.1, 0.02], "position": [0, 0, 0.5]}}
    )
    near = run.call(CLEARANCE, {})
    assert 0.02 < near < upright
    run.call("/world/move", {"name": "above", "position": [0, 0, 0.49]})
    assert run.call(CLEARANCE, {}) == pytest.approx(near - 0.01, abs=1e-6)
    run.call("/world/move", {"name": "above", "position": [0, 0, 0.4]})
    assert run.call(CLEARANCE, {}) < 0
    assert run.call(CLEARANCE, {"positions": {"lift": 1.5}}) > 0


def test_carried_objects_count_as_the_arm(run):
    run.call("/world/attach", {"name": "ball", "link": "hand", "may_touch": ["hand", "finger"]})
    run.call(
        "/world/add",
        {"name": "beside", "object": {"shape": "box", "size": [0.02, 0.1, 0.1], "position": [0.14, 0, 0.6]}},
    )
    assert run.call(CLEARANCE, {}) == pytest.approx(0.01)


MALFORMED = {
    "no size": ("{a: {shape: box}}", "a box needs size; size is missing"),
    "no radius": ("{a: {shape: sphere}}", "a sphere needs radius; radius is missing"),
    "no height": ("{a: {shape: cylinder, radius: 0.1}}", "a cylinder needs radius and height; height is missing"),
    "no file": ("{a: {shape: mesh}}", "a mesh needs file; file is missing"),
    "no shape": ("{a: {size: [1, 1, 1]}}", "required key is missing"),
    "another shape": ("{a: {shape: cone}}", "'cone' is not one of: box, sphere, cylinder, capsule, plane, mesh"),
    "size of a sphere": ("{a: {shape: sphere, radius: 0.1, size: [1, 1, 1]}}", "a sphere has no size; it takes radius"),
    "radius of a plane": ("{a: {shape: plane, radius: 0.1}}", "a plane has no radius; it takes no size"),
    "two lengths": ("{a: {shape: box, size: [1, 1]}}", "expected a list of 3 values, got 2"),
    "flat box": ("{a: {shape: box, size: [1, 1, 0]}}", r"size is \[1.0, 1.0, 0.0\], must be three lengths above 0"),
    "negative radius": ("{a: {shape: sphere, radius: -1}}", "-1.0 is too small, must be above 0 m"),
    "text for a number": ("{a: {shape: sphere, radius: small}}", "expected a number, got 'small'"),
    "unknown key": ("{a: {shape: plane, colour: red}}", "unknown key"),
    "no mapping": ("[a, b]", "expected a mapping, got a list"),
}


@pytest.mark.parametrize(("text", "message"), MALFORMED.values(), ids=MALFORMED)
def test_malformed_worlds_are_refused(text, message):
    with pytest.raises(ConfigError, match=message):
        options(f"objects: {text}")


def test_meshes_and_sizes_are_checked_before_a_run(tmp_path):
    path = tmp_path / "part.stl"
    path.write_text(STL)
    good = options(f"objects: {{part: {{shape: mesh, file: {path}, scale: 0.001}}}}")
    assert list(good.check(make_robot(tmp_path), ())) == []
    assert isinstance(good.objects["part"].made().shape, Mesh)
    for text, message in (
        ("{part: {shape: mesh, file: none.stl}}", "no file .*none.stl"),
        ("{part: {shape: box, size: [600, 800, 20]}}", "at most 100 m"),
        (f"{{part: {{shape: mesh, file: {path}, convex: true}}}}", "a flat mesh has no convex hull"),
    ):
        (fault,) = options(f"objects: {text}").check(make_robot(tmp_path), ())
        assert fault.option == ("objects", "part")
        with pytest.raises(ValueError, match=message):
            raise ValueError(fault.message)


def scene_run(make, tmp_path):
    """A run in which the world has the objects of the simulated scene, besides those of the YAML."""
    world = "world: {scene: true, objects: {table: {shape: plane, position: [0, 0, -0.2]}}}"
    runtime = make(text=robot_yaml(tmp_path) + world)
    runtime.start()
    return runtime


def at(world, name):
    p = world.objects[name].pose.position
    return p.x, p.y, p.z


def test_objects_of_the_simulated_scene_are_where_the_simulation_has_them(make, tmp_path):
    bus = scene_run(make, tmp_path).session.bus
    world = bus.call(SNAPSHOT, None)
    assert {name: type(thing.shape) for name, thing in world.objects.items()} == {
        "table": Plane,
        "floor": Plane,
        "post": Capsule,
        "cube": Box,
        "ball": Sphere,
        "can": Cylinder,
    }
    assert at(world, "cube") == (0.2, 0.05, 0.06)
    poses = np.array([0.1, 0.2, 0.3, 1, 0, 0, 0, 0.4, 0.5, 0.6, 0, 0, 0, 1])
    bus.publish(POSES, Float64MultiArray(poses))
    world = bus.call(SNAPSHOT, None)
    assert (at(world, "cube"), at(world, "ball")) == ((0.1, 0.2, 0.3), (0.4, 0.5, 0.6))
    assert world.objects["ball"].pose.orientation.z == 1.0
    assert at(world, "can") == (0.3, -0.3, 0.05)


def test_attached_object_of_the_scene_moves_with_the_hand(make, tmp_path):
    runtime = scene_run(make, tmp_path)
    bus = runtime.session.bus
    bus.call(ATTACH, {"name": "cube"})
    held = bus.call(SNAPSHOT, None).objects["cube"]
    assert (held.link, held.may_touch) == ("hand", {"hand", "finger"}), "the hand is what the tool's last joint carries"
    bus.publish(POSES, Float64MultiArray(np.array([0.1, 0.2, 0.3, 1, 0, 0, 0] * 2)))
    assert bus.call(SNAPSHOT, None).objects["cube"] == held
    bus.call(DETACH, {"name": "cube"})
    bus.publish(POSES, Float64MultiArray(np.array([0.1, 0.2, 0.3, 1, 0, 0, 0] * 2)))
    assert at(bus.call(SNAPSHOT, None), "cube") == (0.1, 0.2, 0.3)


def test_hand_and_what_it_carries_may_touch_named_objects(make, tmp_path):
    bus = scene_run(make, tmp_path).session.bus
    bus.call(ATTACH, {"name": "cube"})
    bus.call(TOUCH, {"objects": ["can"]})
    objects = bus.call(SNAPSHOT, None).objects
    assert objects["can"].may_touch == {"hand", "finger", "cube"}
    assert objects["table"].may_touch == frozenset()
    bus.call(TOUCH, {})
    assert bus.call(SNAPSHOT, None).objects["can"].may_touch == frozenset()
    with pytest.raises(PlanningError, match="no object 'cup'"):
        bus.call(TOUCH, {"objects": ["cup"]})


def test_name_in_the_yaml_and_in_the_scene_is_refused(make, tmp_path):
    world = "world: {scene: true, objects: {can: {shape: plane}}}"
    with pytest.raises(PlanningError, match=r"has an object 'can'; leave world.objects.can out"):
        make(text=robot_yaml(tmp_path) + world)


def test_scene_is_left_out_unless_asked_for(make, tmp_path):
    runtime = make(text=robot_yaml(tmp_path) + "world: {objects: {can: {shape: plane}}}")
    runtime.start()
    assert set(runtime.session.bus.call(SNAPSHOT, None).objects) == {"can"}


IMPOSSIBLE = (
    (ADD, {"name": "can", "object": {"shape": "plane"}}, PlanningError, "there is an object 'can' already"),
    (ADD, {"name": "cup", "object": {"shape": "box", "size": [600, 1, 1]}}, PlanningError, "at most 100 m"),
    (ADD, {"name": "cup"}, RequestError, "/world/add: object: required key is missing"),
    (ADD, "{name: cup}", RequestError, "expected a mapping with name, object, replace, stamp_ns, got '{name: cup}'"),
    (REMOVE, "cup", PlanningError, "no object 'cup'; the objects are: table, can"),
    (ATTACH, {"name": "can", "link": "foot"}, PlanningError, "no link 'foot'; the links are: world, base"),
    (ATTACH, {"name": "can", "link": ""}, PlanningError, "no link ''"),
    (DETACH, {"name": "can"}, PlanningError, "object 'can' is not attached"),
    (CLEARANCE, {"positions": {"pam": 1.0}}, PlanningError, "no joint 'pam', did you mean 'pan'"),
    (CLEARANCE, {"positions": [1.0]}, RequestError, "positions: expected a mapping, got a list"),
    (CLEARANCE, [1.0], RequestError, "expected a mapping with positions, got a list"),
)


def test_impossible_requests_are_refused(run):
    for service, request, error, message in IMPOSSIBLE:
        with pytest.raises(error, match=message):
            run.call(service, request)
    assert len(run.call(SNAPSHOT, None).objects) == 5


def mesh(file: str) -> dict[str, Any]:
    return {"name": "part", "object": {"shape": "mesh", "file": file}}


FILES = {
    "absolute": "/etc/part.stl",
    "outside of the folder": "../part.stl",
    "of the home": "~/part.stl",
    "outside of a package": "package://ibrobot_planning/../part.stl",
    "no mesh": "/etc/passwd",
    "of the environment": "${HOME}/part.stl",
    "long": "a" * 300 + ".stl",
    "long, in a package": "package://ibrobot_planning/" + "a" * 300 + ".stl",
}
"""Files that a request cannot name, whether they exist or not."""


@pytest.mark.parametrize("file", FILES.values(), ids=FILES)
def test_requests_name_no_file_of_the_machine(run, file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "part.stl").write_text(STL)
    with pytest.raises(RequestError, match="file") as refused:
        run.call(ADD, mesh(file))
    assert str(tmp_path) not in str(refused.value)


def test_requests_name_meshes_of_packages_and_of_the_folder_that_the_yaml_allows(tmp_path: Path):
    folder = tmp_path / "meshes"
    folder.mkdir()
    (folder / "part.stl").write_text(STL)
    (tmp_path / "secret.stl").write_text(STL)
    (folder / "link.stl").symlink_to(tmp_path / "secret.stl")
    session = make_session()
    keeper = WorldKeeper(options(f"meshes: {folder}"), session)
    keeper.start()
    try:
        for file in ("part.stl", str(folder / "part.stl")):
            assert session.bus.call(ADD, mesh(file) | {"replace": True}) == ["part"]
        for file in ("../secret.stl", str(tmp_path / "secret.stl"), "link.stl"):
            with pytest.raises(RequestError, match=r"or a mesh in the folder world\.meshes"):
                session.bus.call(ADD, mesh(file))
        with pytest.raises(RequestError, match=r"the Python package 'ibrobot_planning' has no file 'part\.stl'"):
            session.bus.call(ADD, mesh("package://ibrobot_planning/part.stl"))
    finally:
        keeper.stop()


def test_meshes_of_requests_are_limited_and_the_world_is_served_while_one_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "part.stl").write_text(STL)
    (tmp_path / "large.stl").write_bytes(bytes(LARGEST_MESH + 1))
    session = make_session()
    keeper = WorldKeeper(options(f"meshes: {tmp_path}"), session)
    keeper.start()
    served: list[object] = []

    def slow(*arguments: Any, **more: Any) -> Mesh:
        watching = threading.Thread(target=lambda: served.append(session.bus.call(SNAPSHOT)))
        watching.start()
        watching.join(10)
        return read_mesh(*arguments, **more)

    try:
        with pytest.raises(RequestError, match=f"has {LARGEST_MESH + 1} bytes; a request names meshes of up to"):
            session.bus.call(ADD, mesh("large.stl"))
        monkeypatch.setattr("ibrobot_planning.world.objects.read_mesh", slow)
        assert session.bus.call(ADD, mesh("part.stl")) == ["part"]
        assert len(served) == 1
        monkeypatch.setattr("ibrobot_planning.world.section.MOST_TRIANGLES", 1)
        with pytest.raises(PlanningError, match=r"the meshes would have \d+ triangles; checks of more than 1 take"):
            session.bus.call(ADD, mesh("part.stl") | {"name": "other"})
        assert session.bus.call(ADD, {"name": "table", "object": {"shape": "plane"}}) == ["part", "table"]
    finally:
        keeper.stop()


def test_number_and_names_of_objects_are_limited(run):
    for i in range(MOST_OBJECTS - 5):
        run.call(ADD, {"name": f"post {i}", "object": {"shape": "plane"}})
    with pytest.raises(PlanningError, match=f"there are {MOST_OBJECTS} objects already"):
        run.call(ADD, {"name": "one more", "object": {"shape": "plane"}})
    run.call(ADD, {"name": "post 0", "object": {"shape": "plane"}, "replace": True})


UNREADABLE = ("", " ", "can ", "can\nkeys  Y lets it move", "ca\u202en", "can\u200b", "can\u3164", "\u2800", "a" * 101)
"""Names that people would read as another one, or not at all."""


@pytest.mark.parametrize("name", UNREADABLE)
def test_names_of_objects_are_one_line_that_everybody_reads_the_same(run, name: str) -> None:
    with pytest.raises(RequestError, match="name: a name is one line of 1 to 100 visible characters") as refused:
        run.call(ADD, {"name": name, "object": {"shape": "plane"}})
    assert str(refused.value).isprintable()
    assert name not in {each.name for each in run.call(SHAPES)}


@pytest.mark.parametrize("name", UNREADABLE)
@pytest.mark.parametrize("section", ["objects", "clouds"])
def test_names_in_the_yaml_and_of_scenes_keep_to_the_same_rule(section: str, name: str, tmp_path: Path) -> None:
    thing = {"objects": {"shape": "plane"}, "clouds": {"topic": "/depth"}}[section]
    made = single_options(WorldOptions, (), "world", text=json.dumps({section: {name: thing}}))
    faults = {each.option: each.message for each in made.check(make_robot(tmp_path), ())}
    assert "a name is one line of 1 to 100 visible characters" in faults[section, name]
    scene = SceneObject(name, "plane", (), Pose())
    with pytest.raises(PlanningError, match="an object needs a name: a name is one line"):
        first_world(WorldOptions(), [scene])

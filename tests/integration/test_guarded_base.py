"""A base that twists drive among objects: with its footprint in the YAML it touches none, as MuJoCo sees it."""

from __future__ import annotations

import contextlib
import itertools
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import yaml
from ibrobot_planning.guard.changes import WorldChange
from ibrobot_planning.guard.joints import BaseWays
from ibrobot_planning.world.objects import Box, WorldObject
from plugin_tests import of_tests

from ibrobot_core.api import HardwareError, Pose, Vector, Vector3
from ibrobot_core.app import ConfigError, installed_plugins, load_config
from ibrobot_core.control.commands import ChangeWorld

pytestmark = pytest.mark.integration

driving = of_tests("ibrobot-plugin-lerobot-devices", "driving")
FOOTPRINT = [[0.15, 0.1], [0.15, -0.1], [-0.1, -0.1], [-0.1, 0.1]]
MARGIN_M = 0.05
CLEARANCE = {"type": "clearance", "base": {"footprint": FOOTPRINT, "top": 0.3, "margin": MARGIN_M}}
SIZE = (0.2, 0.3, 0.4)
_OFF_M = 0.002
"""How far the sum of measured velocities may be from where the base is."""


class Judge:
    """Where the base is, by the velocities of its wheels, and MuJoCo's distance of its footprint from boxes."""

    def __init__(self, drive: Any, boxes: Mapping[str, WorldObject]) -> None:
        self._world, self.pose = drive.world, np.zeros(3)
        spec = mujoco.MjSpec()
        body = spec.worldbody.add_body(name="base", mocap=True)
        body.add_geom(name="base", type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.125, 0.1, 0.15], pos=[0.025, 0, 0.15])
        for name, thing in boxes.items():
            p = thing.pose.position
            half = [length / 2 for length in SIZE]
            spec.worldbody.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_BOX, size=half, pos=[p.x, p.y, p.z])
        self._model, self._boxes = spec.compile(), list(boxes)
        self._data = mujoco.MjData(self._model)
        self.nearest, self.driven = 1.0, 0.0
        step = self._world.step

        def watch() -> None:
            begun_ns = self._world.clock.now_ns()
            velocity = self._world.wheels.velocity
            step()
            self._drive(velocity, (self._world.clock.now_ns() - begun_ns) / 1e9)

        drive.world.step = watch

    def _drive(self, velocity: Vector, seconds: float) -> None:
        x, y, turn = velocity * seconds
        if not (x or y or turn):
            return
        heading = self.pose[2] + turn / 2
        cos, sin = np.cos(heading), np.sin(heading)
        self.pose = self.pose + np.array([cos * x - sin * y, sin * x + cos * y, turn])
        self.driven += float(np.hypot(x, y))
        self.nearest = min(self.nearest, self.distance())

    def distance(self) -> float:
        """From the nearest box, at most 1 [m]."""
        self._data.mocap_pos[0] = (*self.pose[:2], 0.0)
        self._data.mocap_quat[0] = (np.cos(self.pose[2] / 2), 0, 0, np.sin(self.pose[2] / 2))
        mujoco.mj_kinematics(self._model, self._data)
        base = self._model.geom("base").id
        return min(
            mujoco.mj_geomDistance(self._model, self._data, base, self._model.geom(name).id, 1.0, None)
            for name in self._boxes
        )


def start(patches: pytest.MonkeyPatch, boxes: Mapping[str, WorldObject], *, guarded: bool = True) -> tuple[Any, Judge]:
    sections = {"control": {"guard": CLEARANCE}} if guarded else {}
    drive = driving.Drive(patches, registry=installed_plugins(), sections=sections)
    if guarded:
        drive.core.handle(ChangeWorld(WorldChange(boxes).message()))
    return drive, Judge(drive, boxes)


def box(x: float, y: float) -> WorldObject:
    return WorldObject(Box(SIZE), Pose(Vector3(x, y, 0.2)))


AHEAD = {"crate": box(0.7, 0.0)}


def test_a_base_stops_in_front_of_what_the_world_lists_and_says_so(monkeypatch) -> None:
    drive, judge = start(monkeypatch, AHEAD)
    drive.drive(np.array([0.3, 0.0, 0.0]), 4.0)
    assert MARGIN_M - _OFF_M < judge.nearest < MARGIN_M + 0.02
    said = [
        json.loads(each["overruled"]) for each in drive.core.events if each["event"] == "guard" and each["overruled"]
    ]
    assert {said[0]["first"], said[0]["second"]} == {"base", "crate"}
    drive.drive(np.array([-0.3, 0.0, 0.0]), 1.0)
    assert judge.distance() > 0.2, "the way back is free"
    drive.close()


def test_it_slides_along_a_wall(monkeypatch) -> None:
    drive, judge = start(monkeypatch, AHEAD)
    drive.drive(np.array([0.3, 0.05, 0.0]), 3.0)
    assert judge.pose[1] > 0.05
    assert judge.nearest > MARGIN_M - _OFF_M
    drive.close()


def test_without_the_guard_it_drives_into_it(monkeypatch) -> None:
    drive, judge = start(monkeypatch, AHEAD, guarded=False)
    drive.drive(np.array([0.3, 0.0, 0.0]), 4.0)
    assert judge.nearest < -0.05
    drive.close()


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.long) for seed in range(1, 6))])
def test_no_twist_leads_into_anything(monkeypatch, seed: int) -> None:
    """Twists of all three axes among boxes; wheels that reach 60 to 100 % of what they are sent."""
    rng = np.random.default_rng(seed)
    boxes = {}
    for number in range(5):
        angle, away = rng.uniform(-np.pi, np.pi), rng.uniform(0.5, 1.0)
        boxes[f"box{number}"] = box(away * np.cos(angle), away * np.sin(angle))
    drive, judge = start(monkeypatch, boxes)
    begun = judge.distance()
    for _ in range(14):
        drive.world.wheels.share = rng.uniform(0.6, 1.0)
        drive.drive(driving.FASTEST * rng.uniform(-1, 1, 3), rng.uniform(0.3, 1.2))
        assert not drive.core.fault
    assert judge.driven > 0.5
    assert judge.nearest > min(MARGIN_M, begun) - _OFF_M
    drive.close()


def test_an_object_that_appears_is_braked_for_at_once(monkeypatch) -> None:
    drive, judge = start(monkeypatch, {"far": box(5.0, 5.0)})
    drive.drive(np.array([0.3, 0.0, 0.0]), 0.6)
    x = judge.pose[0]
    drive.core.handle(ChangeWorld(WorldChange({"crate": box(x + 0.15 + 0.1 + 0.03, 0.0)}).message()))
    drive.tick(1.0)
    braking = 0.3**2 / (2 * 2.0)
    assert judge.pose[0] - x < braking + 0.02, "braking, and what it drives until a velocity reaches its wheels"
    drive.close()


def test_the_pose_is_the_sum_of_ways() -> None:
    """As small steps add it up, whatever the axes are."""
    rng = np.random.default_rng(0)
    for axes in ([0, 1, 2], [0, 2], [1, 2], [0], [2]):
        ways, reference = BaseWays(np.arange(len(axes)), axes), np.zeros(3)
        at = np.zeros(len(axes))
        ways.note(at)
        for _ in range(25):
            step = rng.uniform(-0.05, 0.05, len(axes))
            ahead = ways.path(np.stack([at, at + step]))[-1]
            whole = np.zeros(3)
            whole[axes] = step / 1000
            for _ in range(1000):
                cos, sin = np.cos(reference[2] + whole[2] / 2), np.sin(reference[2] + whole[2] / 2)
                reference += [cos * whole[0] - sin * whole[1], sin * whole[0] + cos * whole[1], whole[2]]
            at = at + step
            ways.note(at)
            assert ways.pose == pytest.approx(reference, abs=1e-7)
            assert ahead == pytest.approx(reference, abs=1e-7)
        ways.note(np.full(len(axes), np.nan))
        assert ways.pose == pytest.approx(reference, abs=1e-6), "a lost reading moves nothing"


BASES: list[tuple[Mapping[str, Any], str]] = [
    ({"footprint": [[0, 0], [1, 0]]}, r"base\.footprint: must be three corners or more"),
    ({"footprint": [[0, 0], [1, 0], [2, 0]]}, r"base\.footprint: the corners .* lie on a line"),
    ({"footprint": [[-10, 0], [10, 0], [0, 2e-7]]}, r"base\.footprint: the corners .* lie on a line, within 1 mm"),
    ({"footprint": FOOTPRINT, "top": 1e-9}, r"base: bottom \(0\) must be below top \(1e-09\), by 1 mm at least"),
    ({"footprint": [[0, 0], [1, 0], [0, 250]]}, r"base\.footprint: must be .* within 10 m"),
    ({"footprint": [[0, 0], [1, 0], [0, float("nan")]]}, r"base\.footprint: must be"),
    ({"footprint": FOOTPRINT, "top": 0.0}, r"base: bottom \(0\) must be below top \(0\)"),
    (
        {"footprint": FOOTPRINT, "x": "vorward", "y": "links", "theta": "turn"},
        r"base: the robot has none of the joints",
    ),
    ({"footprint": FOOTPRINT, "y": "x"}, r"base: x, y and theta must be three joints"),
    ({}, r"base\.footprint: required key is missing"),
]


@pytest.mark.parametrize(("base", "fault"), BASES)
def test_a_base_that_is_none_is_refused(tmp_path: Path, base: Mapping[str, Any], fault: str) -> None:
    document = yaml.safe_load(driving.DOCUMENT) | {"control": {"guard": {"type": "clearance", "base": dict(base)}}}
    document["hardware"] = {"type": "lerobot", "robot": "lekiwi", "units": {}}
    path = tmp_path / "wheels.yaml"
    path.write_text(yaml.safe_dump(document), encoding="utf-8")
    with pytest.raises(ConfigError, match=rf"wheels\.yaml:\d+: control\.guard\.{fault}"):
        load_config(path, sim=False)


def test_clouds_around_a_guarded_base_are_refused(tmp_path: Path) -> None:
    """Their cells are where the base is now, and the world of the guard where it was at the start."""
    path = tmp_path / "wheels.yaml"
    document = yaml.safe_load(driving.DOCUMENT) | {"control": {"guard": CLEARANCE}}
    document["hardware"] = {"type": "lerobot", "robot": "lekiwi", "units": {}}
    document["world"] = {"clouds": {"lidar": {"topic": "/points"}}}
    path.write_text(yaml.safe_dump(document), encoding="utf-8")
    fault = r"wheels\.yaml:\d+: world\.clouds\.lidar: clouds are in the frame of the base, which drives: leave it out"
    with pytest.raises(ConfigError, match=fault):
        load_config(path, sim=False)
    del document["world"]["clouds"]
    path.write_text(yaml.safe_dump(document), encoding="utf-8")
    load_config(path, sim=False)


WRONG = (np.nan, np.inf, -np.inf, 1e308, -1e308)


def hostile_twists(drive: Any, rng: np.random.Generator) -> Iterator[None]:
    """Of numbers that are none, too fast, and to and fro."""
    for wrong, axis in itertools.product(WRONG, range(3)):
        twist = driving.FASTEST * rng.uniform(-1, 1, 3)
        twist[axis] = wrong
        drive.drive(twist, 0.3)
        yield
    for _ in range(10):
        for _ in range(8):
            drive.twist = driving.FASTEST * rng.choice([-9.0, -1.0, 1.0, 9.0], 3)
            drive.tick(rng.uniform(0.01, 0.2))
        yield


def hostile_readings(drive: Any, rng: np.random.Generator) -> Iterator[None]:
    """Readings of single axes that are none, for a while shorter than a fault takes."""
    for fault, axis in itertools.product(("nan", "inf", "-inf", "huge", "missing"), range(3)):
        drive.drive(driving.FASTEST * rng.uniform(-1, 1, 3), 0.4)
        drive.world.fault, drive.world.axis = fault, axis
        drive.tick(0.05)
        drive.world.fault = ""
        drive.tick(0.4)
        if drive.core.fault:
            assert drive.reset()
        yield


def hostile_wheels(drive: Any, rng: np.random.Generator) -> Iterator[None]:
    """Wheels that reach a share of their velocity that changes all the time, or none."""
    for _ in range(15):
        drive.twist = driving.FASTEST * rng.uniform(-1, 1, 3)
        for _ in range(6):
            drive.world.wheels.share = rng.choice([0.0, 0.3, 0.8, 1.0, 1.1])
            drive.tick(0.1)
        if drive.core.fault:
            drive.world.wheels.share = 1.0
            assert drive.reset()
            drive.drive(driving.FASTEST * rng.uniform(-1, 1, 3), 0.1)
        yield


def hostile_worlds(drive: Any, rng: np.random.Generator) -> Iterator[None]:
    """Malformed changes, objects that carry names of the model, floods, and others that come and go far away."""
    far = box(30.0, 30.0)
    right = WorldChange({"far": far}).message()
    for number in range(60):
        drive.twist = driving.FASTEST * rng.uniform(-1, 1, 3)
        drive.tick(0.1)
        wrong: Any = WRONG[number % len(WRONG)]
        thing = dict(right["changed"]["far"])
        messages: list[Any] = [
            {"changed": {"far": {**thing, "pose": [wrong, 0, 0, 0, 0, 0, 1]}}},
            {"changed": {"far": {**thing, "shape": ["box", [0.1, wrong, 0.1]]}}},
            {"changed": {"far": {**thing, "link": "gripper"}}},
            {"changed": {"base": thing, "world": thing}},
            {"changed": {f"far{each}": thing for each in range(100)}},
            {"removed": ["base", "world", "far", *(f"far{each}" for each in range(100))]},
            {"moved": {"box0": [0, 0, wrong, 0, 0, 0, 1]}},
            {"moved": {"nothing": [0, 0, 0, 0, 0, 0, 1]}, "removed": ["nothing"]},
            None,
        ]
        with contextlib.suppress(HardwareError, AttributeError):
            drive.core.handle(ChangeWorld(messages[number % len(messages)]))
        yield


def hostile_stops(drive: Any, rng: np.random.Generator) -> Iterator[None]:
    """Stops and resets in motion, and a program that falls silent."""
    for number in range(24):
        drive.drive(driving.FASTEST * rng.uniform(-1, 1, 3), rng.uniform(0.1, 0.8))
        if number % 3:
            drive.stop()
            drive.tick(rng.uniform(0.01, 0.6))
            assert drive.reset()
        else:
            drive.twists = False
            drive.tick(0.5)
            drive.twists = True
        yield


ATTACKS = (hostile_twists, hostile_readings, hostile_wheels, hostile_worlds, hostile_stops)


@pytest.mark.parametrize("attack", ATTACKS)
def test_a_base_that_is_attacked_touches_nothing(monkeypatch, attack) -> None:
    """Among four boxes from which there is no way far away; each attack has 15 siblings or more."""
    boxes = {f"box{number}": box(*place) for number, place in enumerate(((0.6, 0), (-0.6, 0), (0, 0.65), (0, -0.65)))}
    drive, judge = start(monkeypatch, boxes)
    count = sum(1 for _ in attack(drive, np.random.default_rng(47)))
    assert count >= 15
    assert judge.driven > 0.3, "it has been held nearly all the time"
    assert judge.nearest > MARGIN_M - _OFF_M
    drive.close()

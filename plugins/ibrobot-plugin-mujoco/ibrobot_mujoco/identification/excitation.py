"""The motion that shows the parameters of an arm, as a task: planned, within its limits and guard, and recorded."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Sequence
from itertools import batched
from typing import Any

import attrs
import mujoco
import numpy as np

from ibrobot_core.api import Robot, Vector
from ibrobot_core.app import RequestError, RobotConfig
from ibrobot_mujoco.model import build_model
from ibrobot_mujoco.options import MujocoOptions
from ibrobot_mujoco.scenes import scene

_REACH = 0.6
"""How far arm joints go from the middle pose [rad]."""
_SHARE = 0.4
"""Or this share of their range, if that is less."""
_SMALL = 0.035
"""Half the way of the motions that show backlash [rad]."""
_SPEEDS = (1.0, 0.6, 0.3, 0.1, 0.04)
"""Fractions of the velocity limits, in turn."""
_ALTERNATIVES = 3
_CLEAR_M = 0.09
"""How far the arm keeps from the floor [m], as it hangs below its commands."""
_TRIES = 400
_AT_THE_END = 0.25
"""How far the arm may hang from the end of a motion [rad]."""
_MOST_STEPS = 195
_SECONDS_OF = {1.0: 0.6, 0.6: 0.9, 0.3: 1.6, 0.1: 4.0, 0.04: 9.0}
"""About how long a motion takes at a speed, with its pause [s]."""


@attrs.frozen
class _Unit:
    """What is done in one go."""

    seconds: float
    """About how long it takes [s]."""
    alternatives: tuple[dict[str, Any], ...]
    """Steps, of which the first one that can be planned is done."""


def excitation(config: RobotConfig, minutes: float, seed: int) -> dict[str, Any]:
    """The task, as the values of its YAML.

    Args:
        config: the robot.
        minutes: about how long it takes.
        seed: of its poses.

    Raises:
        RequestError: if no mode of the robot plans motions.
    """
    modes = [mode.name for mode in config.control_modes.values() if mode.planner is not None]
    if not modes:
        raise RequestError(
            f"{config.source}: no mode has a planner, which leads the arm past itself and the table; add one, e.g. "
            "control_modes.moveit_planning={executors: [arm_trajectory, gripper_action], planner: {type: rrt_connect}}"
        )
    mode = config.control_modes[modes[0]]
    moved = [config.executors[name] for name in mode.executors if name in config.executors]
    arm = [joint for each in moved if each.goals == "trajectory" for joint in each.joints]
    grippers = [(each.name, each.joints[0]) for each in moved if each.goals == "position"]
    rng = np.random.default_rng(seed)
    steps = _joined(list(_limited(_units(config.robot, arm, grippers, rng), 60 * minutes)))
    record = {"record": {"of": "task", "prompt": "excitation"}}
    return {"name": "excitation", "mode": mode.name, "steps": [record, *steps]}


def plainly(config: RobotConfig) -> list[str]:
    """Overrides of the robot YAML: without cameras, and with ends of motions that a soft servo reaches.

    A servo with the gain of an SO-101 hangs some degrees below its command when the arm is stretched out.
    """
    document = config.document
    sensors = [each for each in document["contract"]["observations"] if each.get("peripheral") is None]
    return [
        "peripherals=[]",
        f"contract.observations={json.dumps(sensors)}",
        *(
            f"executors.{name}.goal_tolerance={_AT_THE_END}"
            for name, each in config.executors.items()
            if each.type == "trajectory"
        ),
    ]


def _limited(units: Iterator[_Unit], seconds: float) -> Iterator[_Unit]:
    passed = 0.0
    for unit in units:
        if passed >= seconds:
            return
        passed += unit.seconds
        yield unit


def _joined(units: Sequence[_Unit]) -> Iterator[dict[str, Any]]:
    """The steps of a task, which has at most `_MOST_STEPS`: more units share a step."""
    size = max(1, math.ceil(len(units) / _MOST_STEPS))
    for group in batched(units, size):
        count = max(len(each.alternatives) for each in group)
        if count == size == 1:
            yield group[0].alternatives[0]
            continue
        lists = [[each.alternatives[i % len(each.alternatives)] for each in group] for i in range(count)]
        yield {"alternatives": [*lists, [{"wait": {"seconds": 0.1}}]]}


def _height(robot: Robot) -> Callable[[Vector], float]:
    """How far the outer half of the arm is above the floor [m] in a position [rad], shape (J,); or infinite."""
    floor = robot.description.floor
    if floor is None:
        return lambda position: np.inf
    model = build_model(MujocoOptions(scene=scene("empty")), robot, visual=False)
    data = mujoco.MjData(model)
    addresses = [int(model.joint(name).qposadr[0]) for name in robot.joint_names]
    depths = np.zeros(model.nbody, int)  # number of joints between the floor and a body
    for body in range(1, model.nbody):
        depths[body] = depths[model.body_parentid[body]] + model.body_jntnum[body]
    outer = depths[model.geom_bodyid] > depths.max() / 2

    def height(position: Vector) -> float:
        data.qpos[addresses] = position
        mujoco.mj_kinematics(model, data)
        # The half extent along z of each geom's box.
        axes = np.abs(data.geom_xmat.reshape(-1, 3, 3)[:, 2])
        middle = data.geom_xpos[:, 2] + (data.geom_xmat.reshape(-1, 3, 3)[:, 2] * model.geom_aabb[:, :3]).sum(axis=1)
        lowest = middle - (axes * model.geom_aabb[:, 3:]).sum(axis=1)
        return float(lowest[outer].min()) - floor

    return height


class _Poses:
    """Positions of the arm that are clear of the floor."""

    def __init__(self, robot: Robot, arm: list[str], rng: np.random.Generator) -> None:
        self._rng, self._columns = rng, robot.indices(arm)
        lower, upper = robot.lower[self._columns], robot.upper[self._columns]
        self._lower, self._upper = lower + 0.05, upper - 0.05
        self._home = robot.pose("home") if "home" in robot.description.poses else (robot.lower + robot.upper) / 2
        self._height = _height(robot)
        self._reach = np.minimum(_REACH, _SHARE * (upper - lower))
        self.middle = self._home[self._columns]
        if not self._clear(self.middle, 2 * _CLEAR_M):
            wide = [self._drawn(2.0) for _ in range(_TRIES)]
            near = [each for each in wide if self._clear(each, 2 * _CLEAR_M)]
            if not near:
                raise RequestError("no pose of the arm is clear of the floor: put robot.description.floor lower")
            self.middle = min(near, key=lambda each: float(np.abs(each - self.middle).max()))

    def draw(self, share: float = 1.0) -> Vector:
        """A position of the arm [rad], shape (number of joints of the arm,)."""
        for _ in range(_TRIES):
            drawn = self._drawn(share)
            if self._clear(drawn, _CLEAR_M):
                return drawn
        return self.middle

    def _drawn(self, share: float) -> Vector:
        drawn = self.middle + share * self._rng.uniform(-self._reach, self._reach)
        return np.clip(drawn, self._lower, self._upper)

    def _clear(self, arm: Vector, most: float) -> bool:
        position = self._home.copy()
        position[self._columns] = arm
        return self._height(position) >= most


def _units(
    robot: Robot, arm: list[str], grippers: list[tuple[str, str]], rng: np.random.Generator
) -> Iterator[_Unit]:  # fmt: skip
    """The units of the motion, without end."""
    poses = _Poses(robot, arm, rng)
    yield _Unit(1.5, (_move(arm, poses.middle, 0.3),))
    while True:
        for speed in _SPEEDS:
            for _ in range(3 if speed == 1.0 else 1):
                yield _Unit(_SECONDS_OF[speed], tuple(_move(arm, poses.draw(), speed) for _ in range(_ALTERNATIVES)))
            for name, joint in grippers if speed > 0.2 else ():
                column = robot.joint_names.index(joint)
                ends = robot.lower[column] + np.array([0.35, 0.8]) * (robot.upper[column] - robot.lower[column])
                position = round(float(rng.uniform(*ends)), 4)
                yield _Unit(0.5, ({"gripper": {"position": position, "executor": name}},))
        yield _Unit(1.0, ({"wait": {"seconds": 1.0}},))
        here = poses.draw(0.5)
        yield _Unit(0.7, (_move(arm, here, 0.5),))
        for sign in (1.0, -1.0, 1.0, 0.0):
            yield _Unit(0.3, (_move(arm, here + sign * _SMALL, 0.2),))


def _move(arm: list[str], position: Vector, speed: float) -> dict[str, Any]:
    joints = {joint: round(float(each), 4) for joint, each in zip(arm, position, strict=True)}
    return {"move": {"joints": joints, "speed": speed}}

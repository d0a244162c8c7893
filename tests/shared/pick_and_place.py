"""Pick and place by planning among obstacles, in lockstep: placed, touched, limits, equal trajectories for equal seeds.

Each task is the bundled `pick_cube` in a scene of its own: the cube at random, and obstacles that fall or slide when
they are touched, one of them between the cube and the bin. Contacts are those of the physics at each control period.
"""

from __future__ import annotations

import hashlib
import json
from contextlib import suppress
from itertools import product
from pathlib import Path
from typing import Any

import attrs
import mujoco
import numpy as np
from ibrobot_mujoco.model import build_world
from ibrobot_mujoco.options import MujocoOptions
from ibrobot_mujoco.scenes import scene as made_scene
from ibrobot_mujoco.so101 import so101
from ibrobot_mujoco.state import OBJECTS_TOPIC, PHYSICS_TOPIC, DrawnWorld
from ibrobot_planning.tasks.reading import find_task
from ibrobot_planning.tasks.result import TaskResult
from ibrobot_planning.tasks.runner import RESULT, RUN

from ibrobot_core.api import Float64MultiArray, HardwareError, Robot, Vector
from ibrobot_core.app import (
    LaunchRequest,
    Runtime,
    Session,
    Subscription,
    installed_plugins,
    load_config,
    single_options,
)

CONFIG = Path(__file__).parents[2] / "configs" / "so101_pick_cube.yaml"
BIN = np.array([0.10, 0.24])
OBSTACLES = 4
LONGEST_S = 60.0
MOVED_M, TURNED_RAD = 0.001, 0.02
"""An obstacle that moved or turned further was touched."""
CLEAR_OF_CUBE_M, CLEAR_OF_BIN_M, CLEAR_OF_EACH_OTHER_M = 0.11, 0.11, 0.05
"""Least distances of the obstacles' axes; the open gripper and its camera need 10 cm about the cube."""
CLEAR_OF_START_M = 0.02
"""Least distance of obstacles from the arm at rest."""


@attrs.frozen(eq=False)
class Outcome:
    """What happened in one task."""

    seed: int
    placed: bool
    touched: tuple[str, ...]
    """What the robot or the cube touched, besides the cube and, at the grasp, the table, and the bin at the end."""
    beyond: tuple[str, ...]
    """Limits that were exceeded, and interventions of the safety layer."""
    message: str
    duration_s: float
    digest: str
    """Of all commands and joint positions."""


def scene(seed: int, robot: Robot) -> dict[str, Any]:
    """Options of the simulation for a seed: obstacles keep clear of the arm at rest with any opening of the gripper."""
    rng = np.random.default_rng(seed)
    while True:
        values = sample(rng)
        options = single_options(MujocoOptions, (), "scene", text=json.dumps({"objects": values["objects"]}))
        ranges: dict[str, Any] = {name: tuple(ends) for name, ends in values["scene"].items() if name != "type"}
        options = attrs.evolve(options, scene=made_scene(**ranges))
        with suppress(HardwareError):  # no place for the cube
            if len(options.objects) == OBSTACLES and clear_of_start(options, robot):
                return values


def clear_of_start(options: MujocoOptions, robot: Robot) -> bool:
    """Whether all objects are far enough from the robot at the beginning."""
    world, made = build_world(options, robot, visual=False)
    model, physics = world.model, world.data
    physics.qpos[: len(robot.joints)] = robot.pose(options.start_pose)
    made.begin(world, np.random.default_rng(0))  # the only place in its ranges
    robots = [i for i in range(model.ngeom) if model.body(int(model.geom_bodyid[i])).name not in around(options)]
    things = [model.geom(name).id for name in options.objects]
    for opening in np.linspace(0.0, 0.6, 4):
        physics.joint("gripper").qpos = opening
        mujoco.mj_kinematics(model, physics)
        for geom, thing in product(robots, things):
            if mujoco.mj_geomDistance(model, physics, geom, thing, CLEAR_OF_START_M, None) < CLEAR_OF_START_M:
                return False
    return True


def around(options: MujocoOptions) -> set[str]:
    """Bodies that are not of the robot, without the cube."""
    return {"world", "bin", *options.objects}


def sample(rng: np.random.Generator) -> dict[str, Any]:
    """Random options of the simulation."""
    distance, bearing, yaw = rng.uniform(0.20, 0.26), rng.uniform(-0.7, 0.2), rng.uniform(-np.pi, np.pi)
    cube = distance * np.array([np.cos(bearing), np.sin(bearing)])
    places: list[Vector] = []
    objects: dict[str, Any] = {}
    for _ in range(1000):
        if len(objects) == OBSTACLES:
            break
        if objects:
            away, turn = rng.uniform(0.17, 0.36), rng.uniform(-1.5, 1.9)
        else:  # on the way from the cube to the bin
            begin, end = np.arctan2(cube[1], cube[0]), np.arctan2(BIN[1], BIN[0])
            away, turn = rng.uniform(0.22, 0.27), begin + rng.uniform(0.45, 0.6) * (end - begin)
        place = away * np.array([np.cos(turn), np.sin(turn)])
        if np.linalg.norm(place - cube) < CLEAR_OF_CUBE_M or np.linalg.norm(place - BIN) < CLEAR_OF_BIN_M:
            continue
        if any(np.linalg.norm(place - other) < CLEAR_OF_EACH_OTHER_M for other in places):
            continue
        height = float(rng.uniform(0.10, 0.16) if not objects else rng.uniform(0.04, 0.14))
        thing: dict[str, Any] = {"position": [*map(float, place), height / 2], "mass": 0.2}
        if rng.random() < 0.5:
            thing |= {"shape": "cylinder", "radius": float(rng.uniform(0.01, 0.02)), "height": height}
        else:
            size = [*map(float, rng.uniform(0.02, 0.035, 2)), height]
            thing |= {"shape": "box", "size": size, "yaw": float(rng.uniform(-np.pi, np.pi))}
        objects[f"obstacle_{len(objects)}"] = thing
        places.append(place)
    ranges = {"cube_distance": distance, "cube_bearing": bearing, "cube_yaw": yaw}
    drawn = {name: [float(value)] * 2 for name, value in ranges.items()}
    return {"scene": {"type": "pick_cube", **drawn}, "objects": objects}


def perform(seed: int) -> Outcome:
    """One task."""
    registry = installed_plugins()
    changes = [f"simulation.{key}={json.dumps(value)}" for key, value in scene(seed, so101()).items()]
    changes.append("tasks={}")
    config = load_config(CONFIG, overrides=changes, mode="planned", sim=True, registry=registry)
    runtime = Runtime(Session(config, registry, LaunchRequest(lockstep=True, seed=seed, duration_s=LONGEST_S)))
    bus = runtime.session.bus
    states, objects = bus.subscribe(PHYSICS_TOPIC, 100_000), bus.subscribe(OBJECTS_TOPIC, 100_000)
    commands, positions = [], []
    result: TaskResult | None = None
    runtime.start()
    try:
        number = bus.call(RUN, find_task("pick_cube").read_text(encoding="utf-8"))
        while result is None and not runtime.step():
            state = runtime.session.state
            assert state is not None
            commands.append(state.command)
            positions.append(state.position)
            result = bus.call(RESULT, number)
        success = runtime.session.state is not None and bool(runtime.session.state.success)
        counters = runtime.session.counts()
    finally:
        runtime.stop()
    command, position = np.array(commands), np.array(positions)
    touched = contacts(config, values(states))
    touched += moved(values(objects))
    # The gripper's executor begins at full speed, and leaves the acceleration to the safety layer.
    corrected = [name for name, count in counters["interventions"].items() if count and name != "gripper"]
    beyond = exceeded(config, command) + [f"safety: {name}" for name in corrected]
    message = "no result" if result is None else result.message
    return Outcome(
        seed,
        success and result is not None and result.success,
        tuple(dict.fromkeys(touched)),
        tuple(beyond),
        message,
        0.0 if result is None else result.duration_s,
        hashlib.sha256(command.tobytes() + position.tobytes()).hexdigest(),
    )


def values(subscription: Subscription) -> list[Vector]:
    """Everything that a signal has published."""
    messages = (received.message for received in subscription.drain())
    return [message.data for message in messages if isinstance(message, Float64MultiArray)]


def contacts(config: Any, states: list[Vector]) -> list[str]:
    """Pairs of the robot or the cube with something else that touched; names of bodies."""
    followed = DrawnWorld.of(config.simulation.options, config.robot, visual=False)
    model, physics = followed.model, followed.data
    names = [model.body(int(body)).name for body in model.geom_bodyid]
    allowed = {("world", "cube"), ("bin", "cube")}
    found = []
    for state in states:
        followed.follow(state)
        mujoco.mj_collision(model, physics)
        for contact in physics.contact:
            if contact.dist > 0:
                continue
            pair = sorted((names[contact.geom1], names[contact.geom2]))
            if tuple(sorted(pair)) in {tuple(sorted(each)) for each in allowed}:
                continue
            outside = [name for name in pair if name in around(config.simulation.options)]
            if len(outside) == 1:  # objects stand on the table
                found.append(" - ".join(pair))
    return found


def moved(states: list[Vector]) -> list[str]:
    """Obstacles that moved or turned since they came to rest."""
    poses = np.array(states).reshape(len(states), -1, 7)
    settled = poses[min(20, len(poses) - 1)]
    away = np.linalg.norm(poses[20:, :, :3] - settled[:, :3], axis=2).max(axis=0)
    same = np.abs(np.einsum("tij,ij->ti", poses[20:, :, 3:], settled[:, 3:])).clip(max=1.0)
    turned = 2 * np.arccos(same).max(axis=0)
    return [f"obstacle_{i} moved" for i in range(len(settled)) if away[i] > MOVED_M or turned[i] > TURNED_RAD]


def exceeded(config: Any, command: Vector) -> list[str]:
    """Limits of the robot that the commands exceed."""
    robot, rate_hz = config.robot, config.control.rate_hz
    velocity = np.diff(command, axis=0) * rate_hz
    acceleration = np.diff(velocity, axis=0) * rate_hz
    found = []
    for i, joint in enumerate(robot.joints):
        if command[:, i].min() < joint.lower - 1e-9 or command[:, i].max() > joint.upper + 1e-9:
            found.append(f"{joint.name} position")
        if np.abs(velocity[:, i]).max() > 1.001 * joint.max_velocity:
            found.append(f"{joint.name} velocity {np.abs(velocity[:, i]).max():.3f}")
        if np.abs(acceleration[:, i]).max() > 1.02 * joint.max_acceleration:
            found.append(f"{joint.name} acceleration {np.abs(acceleration[:, i]).max():.1f}")
    return found

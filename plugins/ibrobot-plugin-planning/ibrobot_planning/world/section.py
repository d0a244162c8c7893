"""The component of the section `world`: keeps the world of a run, which services change."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, override

import attrs
import numpy as np
from ibrobot_kinematics.clearance import CLEARANCE, Configuration
from ibrobot_kinematics.poses import matrix, pose, pose_at

from ibrobot_core.api import (
    Float64MultiArray,
    HardwareDescriptor,
    PlanningError,
    Pose,
    Quaternion,
    SceneObject,
    Vector,
    Vector3,
    did_you_mean,
    resolve_path,
)
from ibrobot_core.app import Component, NoRequest, PlanCode, Registry, RobotConfig, RunView, Service, Subscription
from ibrobot_planning.world.objects import (
    FLOOR,
    SIMPLE,
    SNAPSHOT,
    Box,
    Mesh,
    Shape,
    World,
    WorldObject,
)
from ibrobot_planning.world.options import Added, Allowed, Attached, Detached, Moved, Named, Touched, WorldOptions

if TYPE_CHECKING:
    from ibrobot_planning.world.arm import Arm
    from ibrobot_planning.world.collision import Clearance

SECTION = "world"
MOST_OBJECTS = 200
"""Most objects of the world; requests for more are refused."""
MOST_TRIANGLES = 200_000
"""Most triangles of the world's meshes; requests for more are refused."""
LARGEST_MESH = 4_000_000
"""Largest mesh file that a request may name [bytes]."""
_MESHES = (".stl", ".obj", ".ply")
_ANSWER = " Answers with the names of all objects."
ADD = Service("/world/add", Added, list, "Add an object." + _ANSWER)
REMOVE = Service("/world/remove", Named, list, "Remove an object." + _ANSWER, alone="name")
MOVE = Service("/world/move", Moved, list, "Move an object." + _ANSWER)
ATTACH = Service("/world/attach", Attached, list, "Let a link carry an object from now on." + _ANSWER)
DETACH = Service("/world/detach", Detached, list, "Put down an object where it is." + _ANSWER)
TOUCH = Service("/world/touch", Touched, list, "Let the hand touch objects, until the next call." + _ANSWER)
ALLOW = Service("/world/allow", Allowed, list, "State what an object may touch." + _ANSWER)
SHAPES: Service[NoRequest, Sequence[SceneObject]] = Service(
    "/world/shapes", NoRequest, Sequence, "The objects in the base frame that have simple shapes."
)
_STILL = 1e-4
"""Smaller changes of an object's position [m] and axes do not count as motion."""


def scene_objects(config: RobotConfig, registry: Registry) -> tuple[SceneObject, ...]:
    """The objects of the simulated scene that the world of a robot has: none without `scene: true`, or on hardware."""
    section = config.plugin_sections.get(SECTION)
    if section is None or not section.options.scene or not config.simulated or config.simulation is None:
        return ()
    descriptor = registry.find("hardware", config.simulation.type)
    assert isinstance(descriptor, HardwareDescriptor)
    return tuple(descriptor.scene(config.simulation.options, config.robot))


def first_world(options: WorldOptions, scene: Sequence[SceneObject]) -> World:
    """The world at the beginning of a run.

    Raises:
        PlanningError: for a name both in the YAML and in the scene.
        ValueError: as `ObjectOptions.made`.
    """
    world = World({name: thing.made() for name, thing in options.objects.items()})
    for thing in scene:
        if thing.name in world.objects:
            raise PlanningError(
                f"the simulated scene has an object {thing.name!r}; leave world.objects.{thing.name} out"
            )
        world = world.add(thing.name, WorldObject(_shape(thing), thing.pose))
    return world


def _shape(thing: SceneObject) -> Shape:
    return Box(thing.size) if thing.shape == "box" else SIMPLE[thing.shape](*thing.size)


def _size(shape: Shape) -> tuple[float, ...]:
    return shape.size if isinstance(shape, Box) else attrs.astuple(shape)


def simple_objects(world: World) -> list[SceneObject]:
    """The objects of a world that stand in the base frame and have a simple shape, e.g. to draw them."""
    kinds = {kind: name for name, kind in SIMPLE.items()}
    return [
        SceneObject(name, kinds[type(shape)], _size(shape), thing.pose)
        for name, thing in world.objects.items()
        if thing.link is None and type(shape := thing.shape) in kinds
    ]


class WorldKeeper(Component):
    """Serves `/world/add`, `remove`, `move`, `attach`, `detach`, `allow` and `touch`; snapshots and clearances.

    A change answers with the names of all objects, and makes a new world, so that planners see consistent ones. Objects
    of the simulated scene are where the simulation has them, unless they are attached.
    """

    def __init__(self, options: WorldOptions, session: RunView) -> None:
        scene = scene_objects(session.config, session.registry)
        self._world = first_world(options, scene)
        super().__init__("world", f"{len(self._world.objects)} objects for planners", ())
        self._session = session
        self._meshes = options.meshes
        self._lock = threading.RLock()
        self._measuring = threading.Lock()
        self._moving = {thing.name: thing for thing in scene if thing.topic}
        """Objects of the scene that may move."""
        self._poses: dict[str, Subscription] = {}
        self._touched: tuple[str, ...] = ()
        self._services: dict[Service[Any, Any], Callable[[Any], Any]] = {
            SNAPSHOT: lambda _: self._snapshot(),
            SHAPES: lambda _: simple_objects(self._snapshot()),
            ADD: self._add,
            REMOVE: self._changing(lambda world, it: world.remove(it.name)),
            MOVE: self._changing(lambda world, it: world.move(it.name, pose_at(it.position, it.rpy))),
            ATTACH: self._changing(self._attach),
            DETACH: self._changing(self._detach),
            TOUCH: self._changing(self._touch),
            ALLOW: self._changing(lambda world, it: world.allow(it.name, frozenset(it.may_touch))),
            CLEARANCE: self._distance,
        }
        self._clearance: tuple[World, Clearance] | None = None
        self._temporary = frozenset({FLOOR, *options.clouds})
        """Names that objects may touch while no object has them."""

    @override
    def start(self) -> None:
        for topic in {thing.topic for thing in self._moving.values()}:
            self._poses[topic] = self._session.bus.subscribe(topic, 1, Float64MultiArray)
        if self._session.config.robot.description.mjcf is not None:
            _ = self._arm  # slow, so not in the first service call
        self._check(self._world)
        for service, handler in self._services.items():
            self._session.bus.serve(service, handler, self._mesh_file)

    @override
    def stop(self) -> None:
        for service in self._services:
            self._session.bus.unserve(service)
        for subscription in self._poses.values():
            subscription.close()
        self._poses.clear()

    def _check(self, world: World) -> None:
        """Refuse a world in which no planner can plan.

        Raises:
            PlanningError: as `World.check`, or without a model of the robot for an object that a link carries.
        """
        carried = any(thing.link is not None for thing in world.objects.values())
        if carried or self._session.config.robot.description.mjcf is not None:
            links = self._arm.frames
            world.check(links, self._temporary)
            if named := sorted(self._temporary & set(links)):
                raise PlanningError(f"a cloud has the name of link {named[0]!r}")

    def _snapshot(self) -> World:
        with self._lock:
            self._world = self._observed()
            world = self._world
            if not self._touched:
                return world
            hand = frozenset(self._hand())
            carried = {name for name, thing in world.objects.items() if thing.link in hand}
            objects = dict(world.objects)
            for name in (name for name in self._touched if name in objects):
                touching = objects[name].may_touch | hand | carried - {name}
                objects[name] = attrs.evolve(objects[name], may_touch=touching)
            return World(objects)

    def _observed(self) -> World:
        """The world with the objects of the scene at their present poses."""
        world = self._world
        for topic, subscription in self._poses.items():
            received = subscription.get()
            if received is None:
                continue
            message = received.message
            assert isinstance(message, Float64MultiArray)
            for name, thing in self._moving.items():
                if thing.topic == topic and name in world.objects and world.objects[name].link is None:
                    x, y, z, qw, qx, qy, qz = message.data[thing.first : thing.first + 7].tolist()
                    now = Pose(Vector3(x, y, z), Quaternion(qx, qy, qz, qw))
                    # Physics jitters: the world stays the same until an object has really moved.
                    if np.abs(matrix(now) - matrix(world.objects[name].pose)).max() > _STILL:
                        world = world.move(name, now)
        return world

    def put(self, name: str, thing: WorldObject | None) -> None:
        """Replace an object, or remove it."""
        with self._lock:
            others = {key: value for key, value in self._world.objects.items() if key != name}
            self._world = World(others if thing is None else {**others, name: thing})

    def _changing[T](self, change: Callable[[World, T], World]) -> Callable[[T], list[str]]:
        def handler(request: T) -> list[str]:
            with self._lock:
                try:
                    world = change(self._observed(), request)
                except ValueError as error:
                    raise PlanningError(str(error)) from error
                self._check(world)
                self._world = world
                return list(self._world.objects)

        return handler

    def _add(self, it: Added) -> list[str]:
        try:
            thing = it.object.made()  # outside the lock: reading a mesh is slow, and motions are checked meanwhile
        except ValueError as error:
            raise PlanningError(str(error)) from error

        def change(world: World, it: Added) -> World:
            if it.replace and it.name in world.objects:
                world = world.remove(it.name)
            if len(world.objects) >= MOST_OBJECTS:
                raise PlanningError(f"there are {MOST_OBJECTS} objects already; checks of more would take too long")
            world = world.add(it.name, thing)
            meshes = [each.shape for each in world.objects.values() if isinstance(each.shape, Mesh)]
            triangles = sum(len(mesh.triangles) for mesh in meshes)
            if isinstance(thing.shape, Mesh) and triangles > MOST_TRIANGLES:
                raise PlanningError(
                    f"the meshes would have {triangles} triangles; checks of more than {MOST_TRIANGLES} take too long"
                )
            return world

        return self._changing(change)(it)

    def _mesh_file(self, text: str) -> Path:
        """The file of a mesh that a request names: of a package, or in the folder that the YAML allows.

        Raises:
            ValueError: for other files, whether they exist or not.
        """
        if Path(text).suffix.lower() not in _MESHES:
            raise ValueError(f"a mesh is a file {', '.join(_MESHES)}, got {text!r}")
        folder = self._meshes.resolve() if self._meshes is not None else None
        if text.startswith("package://"):
            path = resolve_path(text, Path())
        elif folder is None or not (path := (folder / text).resolve()).is_relative_to(folder):
            raise ValueError(f"{text!r}: a request names package://PACKAGE/path, or a mesh in the folder world.meshes")
        if path.is_file() and path.stat().st_size > LARGEST_MESH:
            raise ValueError(
                f"{text!r} has {path.stat().st_size} bytes; a request names meshes of up to {LARGEST_MESH}"
            )
        return path

    def _attach(self, world: World, it: Attached) -> World:
        hand = self._hand() if it.link is None else ()
        link = hand[0] if it.link is None else it.link
        placed = np.linalg.inv(self._link(link)) @ matrix(world.named(it.name).pose)
        return world.attach(it.name, link, pose(placed), frozenset((*hand, *it.may_touch)))

    def _detach(self, world: World, it: Detached) -> World:
        thing = world.named(it.name)
        placed = matrix(thing.pose) if thing.link is None else self._link(thing.link) @ matrix(thing.pose)
        return world.detach(it.name, pose(placed), frozenset(it.may_touch))

    def _touch(self, world: World, it: Touched) -> World:
        for name in it.objects:
            world.named(name)
        self._touched = it.objects
        return world

    @cached_property
    def _arm(self) -> Arm:
        from ibrobot_planning.world.arm import robot_arm

        return robot_arm(self._session.config.robot)

    def _hand(self) -> tuple[str, ...]:
        """The links that the last joint of the tool carries."""
        from ibrobot_kinematics import robot_model

        model = robot_model(self._session.config.robot)
        return self._arm.hand(model.joint_names[model.chain[-1].index])

    def _link(self, link: str) -> Vector:
        """Present pose of a link, shape (4, 4)."""
        return self._arm.link_pose(link, self._session.measured().position)

    def _distance(self, request: Configuration) -> float:
        """Distance of the arm from the nearest object [m]; missing joints are at their measured positions."""
        from ibrobot_planning.world.collision import Clearance

        q = self._session.measured().position.copy()
        robot, positions = self._session.config.robot, request.positions
        for name in positions:
            if name not in robot.joint_names:
                known = did_you_mean(name, robot.joint_names, "the joints are")
                raise PlanningError(f"no joint {name!r}{known}", PlanCode.INVALID_ROBOT_STATE)
        q[robot.indices(tuple(positions))] = list(positions.values())
        world = self._snapshot()
        with self._measuring:
            if self._clearance is None or self._clearance[0] != world:
                self._clearance = world, Clearance(self._arm, world)
            return self._clearance[1](q)[0]

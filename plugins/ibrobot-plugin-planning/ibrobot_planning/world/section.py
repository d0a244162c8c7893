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
    PlanCode,
    PlanningError,
    Pose,
    Quaternion,
    SceneObject,
    Vector,
    Vector3,
    did_you_mean,
    resolve_path,
)
from ibrobot_core.app import Component, NoRequest, RobotConfig, RunView, Service, Subscription
from ibrobot_planning.world.ages import Age, Limit, Unusable
from ibrobot_planning.world.bounds import FURTHEST
from ibrobot_planning.world.hands import hands
from ibrobot_planning.world.objects import (
    FLOOR,
    OBSERVED,
    SIMPLE,
    SNAPSHOT,
    Box,
    Mesh,
    ObservedWorld,
    Shape,
    World,
    WorldObject,
)
from ibrobot_planning.world.options import (
    Added,
    Allowed,
    Attached,
    Detached,
    Moved,
    Named,
    Touched,
    WorldOptions,
)

if TYPE_CHECKING:
    from ibrobot_planning.world.arm import Arm
    from ibrobot_planning.world.collision import Clearance

SECTION = "world"
type _Request = Added | Named | Moved | Attached | Detached | Touched | Allowed
MOST_OBJECTS = 200
"""Most objects of the world; requests for more are refused."""
MOST_TRIANGLES = 200_000
"""Most triangles of the world's meshes; requests for more are refused."""
LARGEST_MESH = 4_000_000
"""Largest mesh file that a request may name [bytes]."""
_MESHES = (".stl", ".obj", ".ply")
_ANSWER = " Answers with the names of all objects."
ADD = Service("/world/add", Added, list, "Add an object." + _ANSWER)
REMOVE = Service("/world/remove", Named, list, "Remove an object." + _ANSWER, alone="name", persons=True)
MOVE = Service("/world/move", Moved, list, "Move an object." + _ANSWER, persons=True)
ATTACH = Service("/world/attach", Attached, list, "Let a link carry an object from now on." + _ANSWER, persons=True)
DETACH = Service("/world/detach", Detached, list, "Put down an object where it is." + _ANSWER)
TOUCH = Service("/world/touch", Touched, list, "Let the hand touch objects, until the next call." + _ANSWER)
ALLOW = Service("/world/allow", Allowed, list, "State what an object may touch." + _ANSWER, persons=True)
SHAPES: Service[NoRequest, Sequence[SceneObject]] = Service(
    "/world/shapes", NoRequest, Sequence, "The objects in the base frame that have simple shapes.", reads=True
)
_MOST_NAMED = 3
"""Clouds and objects that the reason of a refused plan names."""
_NEARLY_ONE = 1e-3
"""Allowed deviation of a quaternion's length from 1."""
_STILL = 1e-4
"""Smaller changes of an object's position [m] and axes do not count as motion."""


def scene_objects(config: RobotConfig) -> tuple[SceneObject, ...]:
    """The objects of the simulated scene that the world of a robot has: none without `scene: true`, or on hardware."""
    section = config.plugin_sections.get(SECTION)
    if section is None or not section.options.scene or not config.simulated or config.simulation is None:
        return ()
    return tuple(config.simulation.options.scene_objects(config.robot))


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
        world = world.add(thing.name, WorldObject(_shape(thing), thing.pose, movable=bool(thing.topic)))
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


def _signalled(message: Float64MultiArray, first: int) -> Pose:
    """The pose in a message of a simulation that begins at index `first`: position [m], and w, x, y, z.

    Raises:
        Unusable: if there is none.
    """
    values = message.data[first : first + 7]
    if len(values) != 7 or not (np.abs(values) <= FURTHEST).all():  # so that NaN fails it
        raise Unusable("malformed", f"seven numbers up to {FURTHEST:g} begin at {first}, got {values.tolist()}")
    x, y, z, qw, qx, qy, qz = values.tolist()
    if abs(np.linalg.norm(values[3:]) - 1) > _NEARLY_ONE:
        raise Unusable("malformed", f"its quaternion has length {np.linalg.norm(values[3:]):.3g}, must be 1")
    return Pose(Vector3(x, y, z), Quaternion(qx, qy, qz, qw))


def _refusal(ages: Sequence[Age]) -> str:
    """Why plans are refused, and what to do, if these parts of the world are too old; empty without any."""
    if not ages:
        return ""
    more = f"; and {len(ages) - _MOST_NAMED} more" if ages[_MOST_NAMED:] else ""
    problems = "; ".join(age.problem for age in ages[:_MOST_NAMED]) + more
    remedies = "; ".join(dict.fromkeys(age.remedy for age in ages[:_MOST_NAMED]))
    return f"the world is not known well enough to plan: {problems}: {remedies}"


class WorldKeeper(Component):
    """Serves `/world/add`, `remove`, `move`, `attach`, `detach`, `allow` and `touch`; snapshots and clearances.

    A change answers with the names of all objects, and makes a new world, so that planners see consistent ones. Objects
    of the simulated scene are where the simulation has them, unless they are attached. While a part of the world is too
    old, snapshots and clearances are refused, or leave it out, by its rule.

    Attributes:
        ages: cloud or object -> its age.
    """

    def __init__(self, options: WorldOptions, session: RunView) -> None:
        scene = scene_objects(session.config)
        self._world = first_world(options, scene)
        super().__init__("world", f"objects for planners: {len(self._world.objects)}", ())
        self._session = session
        self._of_agents: set[str] = set()
        """Names of objects that agents have added."""
        self._lock = threading.RLock()
        self._measuring = threading.Lock()
        self._moving = {thing.name: thing for thing in scene if thing.topic}
        """Objects of the scene that may move."""
        self._poses: dict[str, Subscription] = {}
        self._options = options
        self.ages: dict[str, Age] = {}
        self._touched: tuple[str, ...] = ()
        self._touched_within: object = None
        """The grant of the agent that has said so, after which it no longer holds; None for a person."""
        self._services: dict[Service[Any, Any], Callable[[Any], Any]] = {
            SNAPSHOT: lambda _: self._snapshot(),
            OBSERVED: lambda _: self.observed(),
            SHAPES: lambda _: simple_objects(self.observed().world),
            ADD: self._add,
            REMOVE: self._changing(self._remove),
            MOVE: self._changing(self._move),
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
        self._begin_ages()
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

    def _begin_ages(self) -> None:
        """Let everything age from now on: what the YAML and the scene state holds at the start."""
        options, now_ns = self._options, self._session.clock.now_ns()
        of_scene = Limit(
            options.scene_max_age, options.scene_when_stale, "world.scene_max_age", "world.scene_when_stale"
        )
        for name in self._world.objects:
            limit = of_scene if name in self._moving else Limit()
            if (thing := options.objects.get(name)) is not None:
                limit = Limit.of(f"world.objects.{name}", thing.max_age, thing.when_stale)
            self.ages[name] = self._age(name, limit)
            self.ages[name].renew(now_ns)
        for name, cloud in options.clouds.items():
            limit = Limit.of(f"world.clouds.{name}", cloud.max_age, cloud.when_stale)
            self.ages[name] = self._age(name, limit, f"cloud {name!r} ({cloud.topic})")

    def _age(self, name: str, limit: Limit, what: str = "") -> Age:
        """A new age of a cloud or object."""
        session = self._session
        what = what or f"the pose of object {name!r}"
        return Age(what, limit, session.clock, session.log, session.clock.now_ns())

    def _snapshot(self) -> World:
        """The world, for plans.

        Raises:
            PlanningError: if a part of it is too old, and its rule is to refuse plans.
        """
        observed = self.observed()
        if observed.refusal:
            raise PlanningError(observed.refusal, PlanCode.SENSOR_INFO_STALE)
        return observed.world

    def observed(self) -> ObservedWorld:
        """The world however old it is, without what is forgotten; also logs what has become too old."""
        with self._lock:
            self._world = self._observed()
            world = self._world
            # What a link carries is where the link is.
            carried = {name for name, thing in world.objects.items() if thing.link is not None}
            known = world.objects.keys() | self._options.clouds.keys()
            ages = {name: age for name, age in self.ages.items() if name in known - carried}
            for name, age in ages.items():
                age.report()
                if age.limit.when_stale == "forget" and age.is_stale and name in world.objects:
                    world = world.remove(name)
            refusing = [age for age in ages.values() if age.refuses]
            return ObservedWorld(
                self._with_touched(world),
                {name: age.summary for name, age in ages.items() if age.limit.max_age is not None},
                _refusal(refusing),
                any(age.is_awaited for age in refusing),
            )

    def _with_touched(self, world: World) -> World:
        """The world with what the hand may touch for now."""
        within, granted = self._touched_within, self._session.authority.grant
        if not self._touched or (within is not None and within is not granted):
            return world
        hand = frozenset(hands(self._session.config.robot, self._arm))
        carried = {name for name, thing in world.objects.items() if thing.link in hand}
        objects = dict(world.objects)
        for name in (name for name in self._touched if name in objects):
            touching = objects[name].may_touch | hand | carried - {name}
            objects[name] = attrs.evolve(objects[name], may_touch=touching)
        if FLOOR in self._touched and FLOOR not in objects:  # planners add it, so that nothing is known of it here
            for name in carried:
                objects[name] = attrs.evolve(objects[name], may_touch=objects[name].may_touch | {FLOOR})
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
                if thing.topic != topic or name not in world.objects:
                    continue
                try:
                    now = _signalled(message, thing.first)
                except Unusable as error:
                    self.ages[name].refuse(error)
                    continue
                self.ages[name].renew(received.received_ns)
                # Physics jitters: the world stays the same until an object has really moved.
                placed = world.objects[name]
                if placed.link is None and np.abs(matrix(now) - matrix(placed.pose)).max() > _STILL:
                    world = world.move(name, now)
        return world

    def put(self, name: str, thing: WorldObject | None, measured_ns: int | None = None) -> None:
        """Replace the object of a cloud, or remove it; `measured_ns` is when it was measured, if it was [ns]."""
        with self._lock:
            if measured_ns is not None:
                self.ages[name].renew(measured_ns)
            others = {key: value for key, value in self._world.objects.items() if key != name}
            self._world = World(others if thing is None else {**others, name: thing})

    def _changing[T: _Request](self, change: Callable[[World, T], World]) -> Callable[[T], list[str]]:
        def handler(request: T) -> list[str]:
            with self._lock:
                try:
                    world = change(self._observed(), request)
                    aged = self._aged(request)
                except ValueError as error:
                    raise PlanningError(str(error)) from error
                self._check(world)
                self._world = world
                if aged is not None:
                    name, age, measured_ns = aged
                    self.ages[name] = age
                    age.renew(measured_ns)
                known = {*world.objects, *self._moving, *self._options.clouds}
                self.ages = {name: age for name, age in self.ages.items() if name in known}
                return list(world.objects)

        return handler

    def _aged(self, request: _Request) -> tuple[str, Age, int] | None:
        """The object whose pose a request states, its age, and when it was measured [ns]; None for other requests.

        Raises:
            Unusable: if that is too old, in the future, or before what is known.
        """
        now_ns = self._session.clock.now_ns()
        if isinstance(request, Detached):
            return request.name, self.ages[request.name], now_ns
        if not isinstance(request, Added | Moved):
            return None
        age = self.ages.get(request.name)
        if isinstance(request, Added) and request.name not in self._moving:
            limit = Limit.of("the object", request.object.max_age, request.object.when_stale)
            age = attrs.evolve(self._age(request.name, limit), measured_ns=None if age is None else age.measured_ns)
        assert age is not None
        try:
            return request.name, age, age.measured_at(request.stamp_ns, now_ns)
        except Unusable as error:
            age.refuse(error)
            raise Unusable(error.reason, f"{age.what}: {error}") from error

    def _no_cloud(self, name: str) -> None:
        """Refuse changes of a cloud's cells, which would hide obstacles.

        Raises:
            PlanningError: for the name of a cloud.
        """
        if name in self._options.clouds:
            raise PlanningError(
                f"{name!r} is a cloud, whose cells come from {self._options.clouds[name].topic}",
                PlanCode.INVALID_OBJECT_NAME,
            )

    def _move(self, world: World, it: Moved) -> World:
        self._no_cloud(it.name)
        return world.move(it.name, pose_at(it.position, it.rpy))

    def _check_of_agent(self, world: World, it: Added) -> None:
        """Let an agent only add obstacles: what takes one away is for persons, as are `/world/remove` and `allow`.

        Raises:
            PlanningError: for a request that may let the arm touch more than before.
        """
        known = world.objects.get(it.name)
        if it.replace and known is not None and (known.link is not None or it.name not in self._of_agents):
            raise PlanningError(f"{ADD.name}: replace: {it.name!r} is not of an agent: ask a person to replace it")
        if it.name in self._temporary:
            raise PlanningError(f"{ADD.name}: {it.name!r} is a name for persons only: choose another one")
        if it.object.may_touch or it.object.movable:
            raise PlanningError(f"{ADD.name}: may_touch and movable are for persons only: leave them out")

    def _add(self, it: Added) -> list[str]:
        of_agent = self._session.authority.acting.get() is not None
        try:
            thing = it.object.made()  # outside the lock: reading a mesh is slow, and motions are checked meanwhile
        except ValueError as error:
            raise PlanningError(str(error)) from error

        def change(world: World, it: Added) -> World:
            self._no_cloud(it.name)
            if of_agent:
                self._check_of_agent(world, it)
            if it.replace and it.name in world.objects:
                world = world.remove(it.name)
            if len(world.objects) >= MOST_OBJECTS:
                raise PlanningError(f"there are {MOST_OBJECTS} objects already; checks of more would take too long")
            world = world.add(it.name, thing)
            self._of_agents = self._of_agents | {it.name} if of_agent else self._of_agents - {it.name}
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
        folder = self._options.meshes.resolve() if self._options.meshes is not None else None
        if text.startswith("package://"):
            path = resolve_path(text, Path())
        elif folder is None or not (path := (folder / text).resolve()).is_relative_to(folder):
            raise ValueError(f"{text!r}: a request names package://PACKAGE/path, or a mesh in the folder world.meshes")
        if path.is_file() and path.stat().st_size > LARGEST_MESH:
            raise ValueError(
                f"{text!r} has {path.stat().st_size} bytes; a request names meshes of up to {LARGEST_MESH}"
            )
        return path

    def _remove(self, world: World, it: Named) -> World:
        world = world.remove(it.name)
        # Another object that gets the name later must not be touched for that.
        self._touched = tuple(name for name in self._touched if name != it.name)
        return world

    def _attach(self, world: World, it: Attached) -> World:
        self._no_cloud(it.name)
        hand = self._hand(it.name) if it.link is None else ()
        link = hand[0] if it.link is None else it.link
        placed = np.linalg.inv(self._link(link)) @ matrix(world.named(it.name).pose)
        return world.attach(it.name, link, pose(placed), frozenset((*hand, *it.may_touch)))

    def _detach(self, world: World, it: Detached) -> World:
        if it.may_touch and self._session.authority.acting.get() is not None:
            raise PlanningError(f"{DETACH.name}: may_touch is for persons only: leave it out")
        thing = world.named(it.name)
        placed = matrix(thing.pose) if thing.link is None else self._link(thing.link) @ matrix(thing.pose)
        return world.detach(it.name, pose(placed), frozenset(it.may_touch))

    def _touch(self, world: World, it: Touched) -> World:
        for name in it.objects:
            if name != FLOOR:
                world.named(name)
        self._touched, self._touched_within = it.objects, None
        if self._session.authority.acting.get() is not None:
            self._touched_within = self._session.authority.grant or "a grant that has ended"
        return world

    @cached_property
    def _arm(self) -> Arm:
        from ibrobot_planning.world.arm import robot_arm

        return robot_arm(self._session.config.robot)

    def _hand(self, name: str) -> tuple[str, ...]:
        """The links that the last joint of the tool carries.

        Raises:
            PlanningError: for a robot with several arms, or whose model has no tool: the request has to name the link.
        """
        robot = self._session.config.robot
        links = hands(robot, self._arm)
        if not links or len(robot.description.arms) > 1:
            raise PlanningError(
                f"attach {name!r}: say which link carries it, since robot {robot.name!r} has"
                f" {'several hands' if links else 'no tool'}; the links are: {', '.join(links or self._arm.frames)}",
                PlanCode.INVALID_LINK_NAME,
            )
        return links

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

"""The component of the section `world`: keeps the world of a run, and changes it by services."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, override

import numpy as np

from ibrobot_core.api import Component, PlanningError, Pose, Session, Vector, Vector3, single_options
from ibrobot_planning.arm import Arm, robot_arm
from ibrobot_planning.transforms import from_rpy, matrix, pose
from ibrobot_planning.world import World
from ibrobot_planning.world_options import Added, Attached, Detached, Moved, Named, WorldOptions

SNAPSHOT = "/world/snapshot"
"""Service that answers with the `World` of the run."""


class WorldKeeper(Component):
    """Serves `/world/snapshot`, and `/world/add`, `remove`, `move`, `attach` and `detach`, which take YAML texts.

    A change answers with the names of all objects. Planners see a whole world: each change makes a new one.
    """

    def __init__(self, options: WorldOptions, session: Session) -> None:
        super().__init__("world", f"{len(options.objects)} objects for planners", ())
        self._session = session
        self._lock = threading.Lock()
        self._arm: Arm | None = None
        self._world = World({name: thing.made() for name, thing in options.objects.items()})
        self._services: dict[str, Callable[[Any], Any]] = {
            SNAPSHOT: lambda request: self._world,
            "/world/add": self._changing(Added, lambda world, it: world.add(it.name, it.object.made())),
            "/world/remove": self._changing(Named, lambda world, it: world.remove(it.name)),
            "/world/move": self._changing(Moved, self._move),
            "/world/attach": self._changing(Attached, self._attach),
            "/world/detach": self._changing(Detached, self._detach),
        }

    @override
    def start(self) -> None:
        for name, handler in self._services.items():
            self._session.bus.serve(name, handler)

    @override
    def stop(self) -> None:
        for name in self._services:
            self._session.bus.unserve(name)

    def _changing[T](self, kind: type[T], change: Callable[[World, T], World]) -> Callable[[str], list[str]]:
        def handler(text: str) -> list[str]:
            request = single_options(kind, (), "the request", text=text)
            with self._lock:
                try:
                    self._world = change(self._world, request)
                except ValueError as error:
                    raise PlanningError(str(error)) from error
                return list(self._world.objects)

        return handler

    def _move(self, world: World, it: Moved) -> World:
        return world.move(it.name, Pose(Vector3(*it.position), from_rpy(*it.rpy)))

    def _attach(self, world: World, it: Attached) -> World:
        placed = np.linalg.inv(self._link(it.link)) @ matrix(world.named(it.name).pose)
        return world.attach(it.name, it.link, pose(placed), frozenset(it.may_touch))

    def _detach(self, world: World, it: Detached) -> World:
        thing = world.named(it.name)
        placed = matrix(thing.pose) if thing.link is None else self._link(thing.link) @ matrix(thing.pose)
        return world.detach(it.name, pose(placed), frozenset(it.may_touch))

    def _link(self, link: str) -> Vector:
        """Present pose of a link, shape (4, 4)."""
        if self._arm is None:
            self._arm = robot_arm(self._session.config.robot)
        return self._arm.link_pose(link, self._session.measured().position)

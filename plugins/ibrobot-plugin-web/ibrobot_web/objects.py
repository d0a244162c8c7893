"""The objects around the robot, as pages draw them: those of planners, and those of a simulated scene."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import Any

import attrs
from ibrobot_kinematics.run_frames import SHAPES

from ibrobot_core.api import Float64MultiArray, IbrobotError, SceneObject, Vector
from ibrobot_core.app import RobotConfig, RunView, Subscription

_POSE_SIZE = 7
_log = logging.getLogger("ibrobot.web")


class SceneObjects:
    """The objects of a run: the planners' world, if the run has one, and the simulated scene where it is now.

    Args:
        session: the run.
    """

    def __init__(self, session: RunView) -> None:
        self._session = session
        try:
            self._things = simulated_objects(session.config) if session.config.simulated else []
        except IbrobotError as error:
            _log.warning("the page shows no objects of the scene: %s", error)
            self._things = []
        topics = {each.topic for each in self._things if each.topic}
        self._topics: dict[str, Subscription] = {topic: session.bus.subscribe(topic, 1) for topic in topics}
        self._newest: dict[str, Vector] = {}

    def json(self) -> list[dict[str, Any]]:
        """The objects that are fixed in the base frame, and those of the scene."""
        bus = self._session.bus
        things = bus.call(SHAPES) if bus.serves(SHAPES) else ()
        colours = {thing.name: thing.color for thing in self._things}  # planners know shapes alone
        known = [
            place_of(each if len(each.color) else attrs.evolve(each, color=colours.get(each.name, ())))
            for each in things
            if each.shape != "plane"
        ]
        names = {each["name"] for each in known}
        for topic, subscription in self._topics.items():
            for received in subscription.drain():
                if isinstance(received.message, Float64MultiArray):
                    self._newest[topic] = received.message.data
        return known + [self._placed(thing) for thing in self._things if thing.name not in names]

    def close(self) -> None:
        """End the subscriptions."""
        for subscription in self._topics.values():
            subscription.close()
        self._topics.clear()

    def _placed(self, thing: SceneObject) -> dict[str, Any]:
        vector = self._newest.get(thing.topic)
        place = vector[thing.first : thing.first + _POSE_SIZE] if vector is not None else ()
        pose = place_of(thing)
        if len(place) == _POSE_SIZE:
            pose["pos"] = [round(float(each), 4) for each in place[:3]]
            pose["quat"] = [round(float(each), 3) for each in place[3:]]
        return pose


def place_of(thing: SceneObject) -> dict[str, Any]:
    """An object where it is at the beginning."""
    at, turn = thing.pose.position, thing.pose.orientation
    return {
        "name": thing.name, "type": thing.shape, "size": _half(thing.shape, thing.size), "pos": [at.x, at.y, at.z],
        "quat": [turn.w, turn.x, turn.y, turn.z], "color": [round(float(each), 3) for each in thing.color],
    }  # fmt: skip


def _half(kind: str, size: Sequence[float]) -> list[float]:
    """The size as pages draw it: half lengths, and the radius first."""
    match kind:
        case "box":
            return [round(float(length) / 2, 4) for length in size]
        case "sphere":
            return [round(float(size[0]), 4)] * 3
        case _:
            return [round(float(size[0]), 4), round(float(size[1]) / 2, 4), 0.0]


def simulated_objects(config: RobotConfig) -> list[SceneObject]:
    """The objects of a robot's simulation, without the ground; none if it has no simulation.

    Raises:
        IbrobotError: if the scene cannot be read.
    """
    if config.simulation is None:
        return []
    return [each for each in config.simulation.options.scene_objects(config.robot) if each.shape != "plane"]


def mounts(peripherals: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The mounts of sensors as JSON, for `make_scene`: parents may be frames of other mounts."""
    cameras = []
    for name, each in peripherals.items():
        if (mount := each.transform) is not None:
            cameras.append({
                "name": name, "camera": each.kind == "camera", "frame": mount.frame or f"{name}_frame",
                "parent": mount.parent, "xyz": list(mount.xyz), "rpy": list(mount.rpy or (0.0, 0.0, 0.0)),
                "quaternion": list(mount.quaternion) if mount.quaternion is not None else None,
            })  # fmt: skip
    return cameras

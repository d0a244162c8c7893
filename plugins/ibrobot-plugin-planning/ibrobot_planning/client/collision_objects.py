"""Objects around the robot, with the methods of pymoveit2's `MoveIt2` for them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from pathlib import Path
from typing import Any

from ibrobot_kinematics.rotations import from_quaternion, rpy

from ibrobot_core.api import NotSupported, PlanningError, Pose, PoseStamped, Quaternion, Vector3
from ibrobot_core.app import PlanCode
from ibrobot_planning.client.node import BaseNode
from ibrobot_planning.goals.grammar import check_frame

type Position = Vector3 | Sequence[float]
type Orientation = Quaternion | Sequence[float]
type AnyPose = Pose | PoseStamped

_PRIMITIVES = {1: ("box", ()), 2: ("sphere", ("radius",)), 3: ("cylinder", ("height", "radius"))}
"""Type of shape_msgs/msg/SolidPrimitive -> the shape, and the keys of its dimensions."""


class CollisionObjects:
    """Adds, moves, attaches and removes objects that a robot's motions avoid.

    Args:
        node: the connection to the robot.

    Raises:
        PlanningError: if the robot is in no mode with a planner.
    """

    def __init__(self, node: BaseNode) -> None:
        self._node = node
        self.update_planning_scene()

    def add_collision_box(
        self, id: str, size: Sequence[float], pose: AnyPose | None = None, position: Position | None = None,
        quat_xyzw: Orientation | None = None, frame_id: str | None = None,
    ) -> None:  # fmt: skip
        """Add a box, or replace an object; `size` are its lengths along x, y and z [m]."""
        self._add(id, {"shape": "box", "size": [float(each) for each in size]}, pose, position, quat_xyzw, frame_id)

    def add_collision_sphere(
        self, id: str, radius: float, pose: AnyPose | None = None, position: Position | None = None,
        quat_xyzw: Orientation | None = None, frame_id: str | None = None,
    ) -> None:  # fmt: skip
        """Add a sphere, or replace an object [m]."""
        self._add(id, {"shape": "sphere", "radius": float(radius)}, pose, position, quat_xyzw, frame_id)

    def add_collision_cylinder(
        self, id: str, height: float, radius: float, pose: AnyPose | None = None, position: Position | None = None,
        quat_xyzw: Orientation | None = None, frame_id: str | None = None,
    ) -> None:  # fmt: skip
        """Add a cylinder along its z axis, or replace an object [m]."""
        shape = {"shape": "cylinder", "height": float(height), "radius": float(radius)}
        self._add(id, shape, pose, position, quat_xyzw, frame_id)

    def add_collision_mesh(
        self, filepath: str | Path | None, id: str, pose: AnyPose | None = None, position: Position | None = None,
        quat_xyzw: Orientation | None = None, frame_id: str | None = None, scale: float | Sequence[float] = 1.0,
        mesh: Any = None,
    ) -> None:  # fmt: skip
        """Add a mesh of a file on the robot's machine, or replace an object.

        The file is `package://PACKAGE/path`, or lies in the folder `world.meshes` of the robot YAML.

        Raises:
            NotSupported: for `mesh`, and for a scale that differs along the axes.
        """
        if filepath is None or mesh is not None:
            raise NotSupported("add_collision_mesh takes a file on the robot's machine: filepath")
        scales = {float(scale)} if isinstance(scale, int | float) else {float(each) for each in scale}
        if len(scales) != 1:
            raise NotSupported("add_collision_mesh takes one scale for all axes")
        shape = {"shape": "mesh", "file": str(filepath), "scale": scales.pop()}
        self._add(id, shape, pose, position, quat_xyzw, frame_id)

    def add_collision_primitive(
        self, id: str, primitive_type: int, dimensions: Sequence[float], pose: AnyPose | None = None,
        position: Position | None = None, quat_xyzw: Orientation | None = None, frame_id: str | None = None,
    ) -> None:  # fmt: skip
        """Add a shape of shape_msgs/msg/SolidPrimitive, or replace an object; its dimensions are as there [m].

        Raises:
            NotSupported: unless it is a box, sphere or cylinder.
        """
        if primitive_type not in _PRIMITIVES:
            raise NotSupported(f"primitive type {primitive_type} is not a box (1), sphere (2) or cylinder (3)")
        kind, keys = _PRIMITIVES[primitive_type]
        sizes = [float(each) for each in dimensions]
        if len(sizes) != (len(keys) or 3):
            raise PlanningError(f"a {kind} has {len(keys) or 3} dimensions, got {len(sizes)}")
        shape = dict(zip(keys, sizes, strict=True)) if keys else {"size": sizes}
        self._add(id, {"shape": kind, **shape}, pose, position, quat_xyzw, frame_id)

    def remove_collision_object(self, id: str) -> None:
        """Remove an object.

        Raises:
            PlanningError: if there is none of this name.
        """
        self._node.call("/world/remove", {"name": id})

    remove_collision_mesh = remove_collision_object

    def move_collision(
        self, id: str, position: Position, quat_xyzw: Orientation | None = None, frame_id: str | None = None
    ) -> None:
        """Move an object.

        Raises:
            PlanningError: if there is none of this name.
        """
        self._node.call("/world/move", {"name": id, **self._placed(None, position, quat_xyzw, frame_id)})

    def attach_collision_object(
        self, id: str, link_name: str | None = None, touch_links: Sequence[str] = (), weight: float = 0.0
    ) -> None:
        """Attach an object to a link, by default to the hand, whose links it may touch; it stays where it is on it.

        Raises:
            PlanningError: for an unknown object or link.
        """
        link = None if link_name == self._scene["tip"] else link_name
        self._node.call("/world/attach", {"name": id, "link": link, "may_touch": list(touch_links)})

    attach = attach_collision_object

    def detach_collision_object(self, id: str) -> None:
        """Detach an object; it stays where it is.

        Raises:
            PlanningError: if it is not attached.
        """
        self._node.call("/world/detach", {"name": id})

    detach = detach_collision_object

    def detach_all_collision_objects(self) -> None:
        """Detach all objects."""
        self.update_planning_scene()
        for name, thing in self._scene["objects"].items():
            if thing["link"] is not None:
                self.detach_collision_object(name)

    def clear_all_collision_objects(self) -> Future[bool]:
        """Remove all objects, those of the robot YAML included. The future is done."""
        self.update_planning_scene()
        for name in self._scene["objects"]:
            self.remove_collision_object(name)
        return _done()

    def process_clear_all_collision_objects_future(self, future: Future[bool]) -> bool:
        """Whether the objects were removed."""
        return future.result()

    def cancel_clear_all_collision_objects_future(self, future: Future[bool]) -> None:
        """Do nothing: the objects were removed at once."""

    def allow_collisions(self, id: str, allow: bool) -> Future[bool]:
        """Let an object touch everything, or nothing but the link that carries it. The future is done.

        Raises:
            PlanningError: if there is none of this name.
        """
        self.update_planning_scene()
        others = [*self._scene["links"], *(name for name in self._scene["objects"] if name != id)]
        self._node.call("/world/allow", {"name": id, "may_touch": others if allow else []})
        return _done()

    def process_allow_collision_future(self, future: Future[bool]) -> bool:
        """Whether `allow_collisions` succeeded."""
        return future.result()

    def update_planning_scene(self) -> bool:
        """Ask for the robot and its objects; see `planning_scene`."""
        self._scene: Mapping[str, Any] = self._node.call("/get_planning_scene")
        return True

    @property
    def planning_scene(self) -> Mapping[str, Any]:
        """The robot and its objects at the last `update_planning_scene`: the robot's `PlanningScene` as a mapping."""
        return self._scene

    def add_collision_cone(self, *arguments: Any, **options: Any) -> None:
        """Raise NotSupported."""
        raise NotSupported("the world has no cones; add a cylinder or a mesh")

    def _add(
        self, name: str, shape: Mapping[str, Any], pose: AnyPose | None, position: Position | None,
        quat_xyzw: Orientation | None, frame_id: str | None,
    ) -> None:  # fmt: skip
        placed = self._placed(pose, position, quat_xyzw, frame_id)
        self._node.call("/world/add", {"name": name, "object": {**shape, **placed}, "replace": True})

    def _placed(
        self, pose: AnyPose | None, position: Position | None, quat_xyzw: Orientation | None, frame_id: str | None
    ) -> dict[str, list[float]]:
        """Keys `position` and `rpy` of an object."""
        if isinstance(pose, PoseStamped):
            frame_id, pose = frame_id or pose.header.frame_id, pose.pose
        if pose is not None:
            position, quat_xyzw = pose.position, pose.orientation
        check_frame(frame_id or "")
        if position is None:
            raise PlanningError(
                "the object needs a place: pose, or position and quat_xyzw", PlanCode.INVALID_OBJECT_NAME
            )
        turn = numbers(quat_xyzw, "xyzw") if quat_xyzw is not None else (0.0, 0.0, 0.0, 1.0)
        return {"position": numbers(position, "xyz"), "rpy": rpy(from_quaternion(turn)).tolist()}


def numbers(values: Vector3 | Quaternion | Sequence[float], names: str) -> list[float]:
    """Components of a vector or quaternion.

    Raises:
        PlanningError: if their number is not that of `names`.
    """
    if isinstance(values, Vector3):
        values = (values.x, values.y, values.z)
    elif isinstance(values, Quaternion):
        values = (values.x, values.y, values.z, values.w)
    components = [float(each) for each in values]
    if len(components) != len(names):
        raise PlanningError(
            f"expected {', '.join(names)}, got {len(components)} numbers", PlanCode.INVALID_GOAL_CONSTRAINTS
        )
    return components


def _done() -> Future[bool]:
    future: Future[bool] = Future()
    future.set_result(True)
    return future

"""Options of the section `world`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import attrs
from ibrobot_kinematics.visible_names import name_fault

from ibrobot_core.api import OptionFault, Options, did_you_mean, documented, option
from ibrobot_planning.world.ages import WhenStale
from ibrobot_planning.world.bounds import FURTHEST

if TYPE_CHECKING:
    from ibrobot_core.api import Robot
    from ibrobot_planning.world.objects import WorldObject

_KEYS = {
    "box": ("size",),
    "sphere": ("radius",),
    "cylinder": ("radius", "height"),
    "capsule": ("radius", "height"),
    "plane": (),
    "mesh": ("file",),
}
"""Shape -> the keys that it needs."""
_RULE = "when it is older: `refuse` plans and stop planned motions, `keep` what was seen last, or `forget` it"


def near(instance: object, attribute: attrs.Attribute[Any], value: Sequence[float] | None) -> None:
    """Check that numbers are plausible as positions [m] or angles [rad].

    Raises:
        ValueError: if one is not.
    """
    # Written so that NaN fails it.
    if not all(abs(number) <= FURTHEST for number in value or ()):
        raise ValueError(f"must be numbers from -{FURTHEST:g} to {FURTHEST:g}, got {list(value or ())}")


@documented
@attrs.frozen
class ObjectOptions:
    """One object of the world."""

    shape: Literal["box", "sphere", "cylinder", "capsule", "plane", "mesh"] = option(
        help="box about its centre, sphere, cylinder or capsule along z, everything below z = 0, or triangles of a file"
    )
    size: tuple[float, float, float] | None = option(
        None, unit="m", validator=near, help="lengths of a box along x, y and z"
    )
    radius: float | None = option(None, unit="m", gt=0, help="of a sphere, cylinder or capsule")
    height: float | None = option(None, unit="m", gt=0, help="of a cylinder, or of the cylinder of a capsule")
    file: Path | None = option(None, help="mesh: STL, OBJ or PLY")
    scale: float = option(1.0, gt=0, help="factor of the mesh's numbers, e.g. 0.001 for millimetres")
    convex: bool = option(False, help="take the mesh's convex hull: solid, and faster to check")
    position: tuple[float, float, float] = option((0.0, 0.0, 0.0), unit="m", validator=near, help="in the base frame")
    rpy: tuple[float, float, float] = option(
        (0.0, 0.0, 0.0), unit="rad", validator=near, help="turns about the base's x, y and z axis"
    )
    link: str | None = option(None, help="link of the MJCF that carries it; its position and turns are in that frame")
    may_touch: tuple[str, ...] = option((), help="links and objects that it may touch")
    movable: bool = option(
        False, help="the guard lets the hand grasp and push it, e.g. for a policy; planners keep away nevertheless"
    )
    max_age: float | None = option(
        None, unit="s", gt=0, help="greatest age of its pose, which /world/move renews; none: it stays where it is"
    )
    when_stale: WhenStale = option("refuse", help=_RULE)

    def __attrs_post_init__(self) -> None:
        needed = _KEYS.get(self.shape, ())
        values = {"size": self.size, "radius": self.radius, "height": self.height, "file": self.file}
        for key, value in values.items():
            if key in needed and value is None:
                raise ValueError(f"a {self.shape} needs {' and '.join(needed)}; {key} is missing")
            if key not in needed and value is not None:
                takes = f"it takes {' and '.join(needed)}" if needed else "it takes no size"
                raise ValueError(f"a {self.shape} has no {key}; {takes}")
        if self.size is not None and min(self.size) <= 0:
            raise ValueError(f"size is {list(self.size)}, must be three lengths above 0")

    def made(self) -> WorldObject:
        """The object.

        Raises:
            ValueError: for an implausible size, or a mesh that cannot be read.
        """
        from ibrobot_kinematics.poses import pose_at

        from ibrobot_planning.world.objects import SIMPLE, Shape, WorldObject, read_mesh

        shape: Shape
        if self.shape == "mesh":
            assert self.file is not None
            shape = read_mesh(self.file, self.scale, convex=self.convex)
        else:
            sizes = attrs.asdict(self, filter=lambda field, _: field.name in _KEYS[self.shape])
            shape = SIMPLE[self.shape](**sizes)
        return WorldObject(shape, pose_at(self.position, self.rpy), self.link, self.may_touch, self.movable)


def _check_topic(instance: object, attribute: attrs.Attribute[str], value: str) -> None:
    if not value.startswith("/"):
        raise ValueError(f"{value!r} is not a topic: a topic begins with /, e.g. /camera/top/image_raw")


@documented
@attrs.frozen
class CloudOptions:
    """A point cloud or a depth image that becomes occupied cells of the world."""

    topic: str = option(
        validator=_check_topic, help="sensor_msgs/msg/PointCloud2, or Image with encoding 16UC1 [mm] or 32FC1 [m]"
    )
    info: str = option("", help="topic of the depth camera's CameraInfo; camera_info beside the topic if empty")
    frame: str = option("", help="frame of the sensor; that of the messages if empty")
    cell: float = option(0.02, unit="m", ge=0.002, le=0.2, help="edge of a cell")
    furthest: float = option(1.5, unit="m", gt=0, help="points beyond this distance from the camera are ignored")
    reach: float = option(1.0, unit="m", gt=0, help="points beyond this distance from the base are ignored")
    least_points: int = option(3, ge=1, help="points that make a cell occupied; a larger number drops outliers")
    margin: float = option(
        0.02,
        unit="m",
        ge=0,
        help="cells this near to the arm, or to what it carries, are ignored",
    )
    rate: float = option(2.0, unit="Hz", gt=0, le=30, help="updates per second, at most")
    keep: float = option(0.0, unit="s", ge=0, help="how long cells stay after they were last seen; 0: until the next")
    most_cells: int = option(20_000, ge=1, help="occupied cells, at most; those nearest to the base are kept")
    max_age: float = option(1.5, unit="s", gt=0, help="greatest age of the newest usable message, by its stamp")
    when_stale: WhenStale = option("refuse", help=_RULE)
    least_valid: float = option(
        0.05,
        ge=0,
        le=1,
        help="a message is refused as that of a covered sensor if it measures less than this share of its points or"
        " pixels, or of the points of the last ten; 0: an empty message is an empty world",
    )
    transform_tolerance: float = option(
        0.5, unit="s", gt=0, help="greatest difference between the time of a message and that of its frame on /tf"
    )


@documented
@attrs.frozen
class WorldOptions(Options):
    """The section `world`: the objects around the robot, for planners."""

    objects: Mapping[str, ObjectOptions] = option(factory=dict, help="objects by name")
    clouds: Mapping[str, CloudOptions] = option(factory=dict, help="point clouds and depth images by name")
    meshes: Path | None = option(
        None, help="folder of meshes that requests to /world/add may use, besides meshes of packages"
    )
    scene: bool = option(False, help="add the objects of a simulation's scene, at their present poses")
    scene_max_age: float = option(1.0, unit="s", gt=0, help="greatest age of the poses of the scene's objects")
    scene_when_stale: WhenStale = option("refuse", help=_RULE)

    def without_ages(self) -> WorldOptions:
        """The same world without clouds and limits of ages, for plans without a run, in which nothing is measured."""
        objects = {name: attrs.evolve(thing, max_age=None) for name, thing in self.objects.items()}
        return attrs.evolve(self, objects=objects, clouds={}, scene_when_stale="keep")

    def check(self, robot: Robot, joints: tuple[str, ...]) -> Iterable[OptionFault]:
        """Check the names, that the objects have sensible sizes, and that meshes can be read."""
        for section, names in (("objects", self.objects), ("clouds", self.clouds)):
            for name in names:
                if fault := name_fault(name):
                    yield OptionFault((section, name), fault)
        for name, thing in self.objects.items():
            try:
                thing.made()
            except ValueError as error:
                yield OptionFault(("objects", name), str(error))
        yield from self._unknown_names(robot)
        for name, cloud in self.clouds.items():
            if name in self.objects:
                yield OptionFault(
                    ("clouds", name), f"there is an object {name!r} already; clouds need names of their own"
                )
            if cloud.max_age <= 1 / cloud.rate:
                yield OptionFault(
                    ("clouds", name, "max_age"),
                    f"{cloud.max_age:g} s is too small for rate {cloud.rate:g} Hz: the cells would be too old before "
                    f"the next update; set it above {1 / cloud.rate:g} s, or rate above {1 / cloud.max_age:g} Hz",
                )

    def _unknown_names(self, robot: Robot) -> Iterable[OptionFault]:
        """Faults of names that are neither a link of the robot's model nor an object."""
        from ibrobot_planning.world.objects import FLOOR

        mjcf, links = robot.description.mjcf, link_names(robot)
        if mjcf is None or not links:
            return
        known = [*links, *self.objects, *self.clouds, FLOOR]
        for name, thing in self.objects.items():
            if name in links:
                yield OptionFault(("objects", name), f"a link of {mjcf.name} has this name already")
            if thing.link is not None and thing.link not in links:
                yield OptionFault(
                    ("objects", name, "link"), f"unknown link {thing.link!r}{did_you_mean(thing.link, links, 'known')}"
                )
            for i, other in enumerate(thing.may_touch):
                if other not in known and not self.scene:  # objects of the scene are checked at the start
                    message = f"unknown link or object {other!r}{did_you_mean(other, known, 'known')}"
                    yield OptionFault(("objects", name, "may_touch", i), message)


def link_names(robot: Robot) -> list[str]:
    """Links of the robot's MJCF; none without one, or if it cannot be read, which its own check reports."""
    from ibrobot_kinematics.errors import KinematicsError
    from ibrobot_kinematics.mjcf_names import read_names

    if robot.description.mjcf is None:
        return []
    try:
        model = read_names(robot.description.mjcf)
    except KinematicsError:
        return []
    prefixes = tuple(robot.description.arms) or ("",)
    return [prefix + name for prefix in prefixes for name in ("world", *model.bodies)]


def _visible(instance: object, attribute: attrs.Attribute[str], value: str) -> None:
    if fault := name_fault(value):
        raise ValueError(fault)


@documented
@attrs.frozen
class Added:
    """A request to `/world/add`."""

    name: str = option(validator=_visible, help="a name that no object has")
    object: ObjectOptions = option(help="the object, as in the YAML")
    replace: bool = option(False, help="replace an object of this name")
    stamp_ns: int = option(0, unit="ns", ge=0, help="when its pose was measured; 0: now")


@documented
@attrs.frozen
class Named:
    """A request to `/world/remove`."""

    name: str = option(help="the object's name")


@documented
@attrs.frozen
class Moved:
    """A request to `/world/move`."""

    name: str = option(help="the object's name")
    position: tuple[float, float, float] = option(
        unit="m", validator=near, help="in the object's frame: of the base, or of the link that carries it"
    )
    rpy: tuple[float, float, float] = option((0.0, 0.0, 0.0), unit="rad", help="turns about its x, y and z axis")
    stamp_ns: int = option(0, unit="ns", ge=0, help="when its pose was measured; 0: now")


@documented
@attrs.frozen
class Attached:
    """A request to `/world/attach`: the object keeps its pose relative to the link."""

    name: str = option(help="the object's name")
    link: str | None = option(
        None, help="the link of the MJCF that carries it from now on; None: the hand, whose links it may touch"
    )
    may_touch: tuple[str, ...] = option((), help="further links that it may touch, e.g. the other finger")


@documented
@attrs.frozen
class Detached:
    """A request to `/world/detach`: the object stays where it is."""

    name: str = option(help="the object's name")
    may_touch: tuple[str, ...] = option((), help="what it may touch from now on, e.g. the table")


@documented
@attrs.frozen
class Touched:
    """A request to `/world/touch`, in place of the previous one."""

    objects: tuple[str, ...] = option(
        (), help="objects that the hand and its load may touch; `floor` lets the load touch the planner's floor"
    )


@documented
@attrs.frozen
class Allowed:
    """A request to `/world/allow`."""

    name: str = option(help="the object's name")
    may_touch: tuple[str, ...] = option((), help="all links and objects that it may touch from now on")

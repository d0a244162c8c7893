"""Read a URDF or xacro file. Every fault is an error that names file, line, value, and what would be right."""

from __future__ import annotations

import math
import re
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path

import attrs

from ibrobot_core.api import HardwareError, did_you_mean
from ibrobot_core.app import ModelError, XmlElement, read_xml
from ibrobot_mujoco.ros_packages import Packages
from ibrobot_mujoco.xacro_file import PLACE, expand_xacro

_TYPES = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar")
_STILL = ("fixed", "floating", "planar")
"""Types of joints that do not move here."""
_SIZES: Mapping[str, tuple[tuple[str, int], ...]] = {
    "box": (("size", 3),),
    "cylinder": (("radius", 1), ("length", 1)),
    "capsule": (("radius", 1), ("length", 1)),
    "sphere": (("radius", 1),),
    "mesh": (),
}
"""Shape -> its attributes, with the number of values of each."""
_MOST = 1e6
"""Largest value of a robot, in any unit of the SI."""
_WHEEL = re.compile(r"wheel|caster", re.IGNORECASE)
_TURNS = 100.0
"""Limits beyond it are those of a joint without end [rad]."""
_LISTED = 6


@attrs.frozen
class Shape:
    """A collision shape."""

    kind: str
    size: tuple[float, ...]
    """All sides of a box; radius and length of a cylinder or capsule; radius of a sphere; scale of a mesh [m]."""
    xyz: tuple[float, ...]
    rpy: tuple[float, ...]
    place: str
    mesh: str = ""
    """The file as the URDF names it."""


@attrs.frozen
class Inertial:
    """Mass [kg], and inertia [kg m^2] about its centre: xx, yy, zz, xy, xz, yz; no inertia if the URDF has none."""

    mass: float
    inertia: tuple[float, ...]
    xyz: tuple[float, ...]
    rpy: tuple[float, ...]


@attrs.frozen
class Link:
    """A link."""

    name: str
    place: str
    inertial: Inertial | None
    shapes: tuple[Shape, ...]


@attrs.frozen
class Mimic:
    """A joint follows another one: multiplier * joint + offset."""

    joint: str
    multiplier: float
    offset: float


@attrs.frozen
class UrdfJoint:
    """A joint; limits are None where the URDF has none, or they never bind."""

    name: str
    type: str
    place: str
    parent: str
    child: str
    xyz: tuple[float, ...]
    rpy: tuple[float, ...]
    axis: tuple[float, ...]
    limits: tuple[float, float] | None
    effort: float
    """0 if the URDF states none."""
    velocity: float
    """0 if the URDF states none."""
    mimic: Mimic | None


@attrs.frozen
class Urdf:
    """A robot: a tree of links."""

    name: str
    file: Path
    links: Mapping[str, Link]
    joints: Mapping[str, UrdfJoint]
    """Joint by the name of its child link, in an order in which parents come first."""
    root: str
    notes: tuple[str, ...]
    """What was left out, or is used in another way."""


def several(names: list[str]) -> str:
    """A list of names for a note."""
    more = len(names) - _LISTED
    return ", ".join(names[:_LISTED]) + (f" and {more} more" if more > 0 else "")


def read_urdf(path: Path, packages: Packages, arguments: Mapping[str, str]) -> Urdf:
    """Read a URDF, or expand a xacro file to one.

    Args:
        path: the file.
        packages: where the packages are that it names.
        arguments: values of a xacro file's arguments.

    Raises:
        HardwareError: if it has a fault.
    """
    try:
        root = _root(path, packages, arguments)
        if root.tag != "robot":
            raise root.error(f"is not a URDF: its first element is <{root.tag}>, must be <robot>")
        return _Reader(path).read(root)
    except ModelError as error:
        raise HardwareError(str(error)) from None


def _root(path: Path, packages: Packages, arguments: Mapping[str, str]) -> XmlElement:
    try:
        text = path.read_bytes()
    except OSError as error:
        raise HardwareError(f"{path}: cannot be read: {error.strerror}") from None
    if b"xacro:" not in text:
        if arguments:
            raise HardwareError(f"{path} is not a xacro file, so it has no argument {next(iter(arguments))!r}")
        return read_xml(path)
    with tempfile.TemporaryDirectory() as folder:
        expanded = Path(folder) / path.name
        expanded.write_text(expand_xacro(path, packages, arguments), encoding="utf-8")
        return _placed(read_xml(expanded), path)


def _placed(element: XmlElement, path: Path) -> XmlElement:
    """The element with the places in the xacro files."""
    file, _, line = element.attributes.get(PLACE, f"{path}:0").rpartition(":")
    children = [_placed(each, path) for each in element.children]
    return XmlElement(element.tag, element.attributes, Path(file), int(line), children)


@attrs.define
class _Reader:
    """Reads one file, and collects what it leaves out."""

    file: Path
    empty: list[str] = attrs.field(factory=list)
    visual: list[str] = attrs.field(factory=list)
    bases: list[str] = attrs.field(factory=list)
    wheels: list[str] = attrs.field(factory=list)
    still: list[str] = attrs.field(factory=list)

    def read(self, root: XmlElement) -> Urdf:
        links = {name: self._link(name, each) for name, each in _named(root, "link").items()}
        if not links:
            raise root.error(
                "has no <link>; a xacro file that only defines macros is included by another one: give that"
            )
        by_name = {name: (each, self._joint(name, each, links)) for name, each in _named(root, "joint").items()}
        joints = self._tree(links, by_name, root)
        top = next(name for name in links if name not in joints)
        if "world" in links and top != "world":
            raise HardwareError(f"{links['world'].place}: the link 'world' must be the one without a parent joint")
        self._mimics(joints, by_name)
        for joint in joints.values():
            if joint.type in ("floating", "planar") and joint.parent != top:
                raise HardwareError(
                    f"{joint.place}: joint {joint.name!r} is {joint.type}; only the base may have such a joint: make "
                    "it fixed, or use a URDF without its link"
                )
        notes = (
            ("Shapes without any size are left out: {}.", self.empty),
            ("Without collision shapes in the URDF, those for the eye are used: {}.", self.visual),
            ("The base stands still, whatever moves it in the URDF: {}.", self.bases),
            ("Wheels do not turn: {}.", self.wheels),
            ("Fixed, since the upper and the lower limit in the URDF are equal: {}.", self.still),
        )
        texts = tuple(text.format(several(names)) for text, names in notes if names)
        return Urdf(root.attributes.get("name", ""), self.file, links, joints, top, texts)

    def _link(self, name: str, element: XmlElement) -> Link:
        collisions = [each for each in element.children if each.tag == "collision"]
        shown = [each for each in element.children if each.tag == "visual"]
        shapes = [shape for each in collisions or shown for shape in self._shapes(name, each)]
        if shapes and not collisions:
            self.visual.append(name)
        place = f"{element.file}:{element.line}"
        return Link(name, place, _inertial(name, element), tuple(shapes))

    def _shapes(self, link: str, element: XmlElement) -> Iterator[Shape]:
        xyz, rpy = _origin(element)
        geometry = _child(element, "geometry")
        if geometry is None:
            raise element.error(f"link {link!r}: <{element.tag}> has no <geometry>")
        for each in geometry.children:
            if each.tag not in _SIZES:
                raise each.error(f"link {link!r}: unknown shape <{each.tag}>; the shapes are: {', '.join(_SIZES)}")
            place = f"{each.file}:{each.line}"
            if each.tag == "mesh":
                file = each.attributes.get("filename", "").strip()
                if not file:
                    raise each.error(f"link {link!r}: <mesh> has no filename")
                scale = _numbers(each, "scale", "1 1 1", 3)
                if 0.0 in scale:
                    self.empty.append(link)
                    continue
                yield Shape("mesh", scale, xyz, rpy, place, file)
                continue
            for name, _ in _SIZES[each.tag]:
                if name not in each.attributes:
                    raise each.error(f"link {link!r}: <{each.tag}> has no {name}")
            size = tuple(value for name, count in _SIZES[each.tag] for value in _numbers(each, name, "", count))
            if min(size) < 0:
                raise each.error(f"link {link!r}: <{each.tag}> has a size below zero: {min(size):g}")
            if min(size) == 0:
                self.empty.append(link)
            else:
                yield Shape(each.tag, size, xyz, rpy, place)

    def _joint(self, name: str, element: XmlElement, links: Mapping[str, Link]) -> UrdfJoint:
        type_ = element.attributes.get("type", "")
        if type_ not in _TYPES:
            raise element.error(f"joint {name!r}: its type is {type_!r}, must be one of {', '.join(_TYPES)}")
        ends = []
        for side in ("parent", "child"):
            child = _child(element, side)
            link = child.attributes.get("link", "") if child is not None else ""
            if not link:
                raise element.error(f"joint {name!r} has no <{side} link=…/>")
            if link not in links:
                raise (child or element).error(
                    f"joint {name!r}: unknown link {link!r}{did_you_mean(link, list(links), 'the links are')}"
                )
            ends.append(link)
        if ends[0] == ends[1]:
            raise element.error(f"joint {name!r}: parent and child are the same link, {ends[0]!r}")
        xyz, rpy = _origin(element)
        axis = _child(element, "axis")
        direction = _numbers(axis, "xyz", "1 0 0", 3) if axis is not None else (1.0, 0.0, 0.0)
        if type_ not in _STILL and math.hypot(*direction) < 1e-6:
            raise (axis or element).error(f"joint {name!r}: its axis is zero, must have a direction, e.g. 0 0 1")
        mimic = _mimic(name, element)
        limits, effort, velocity = _limits(name, type_, element)
        if type_ in ("floating", "planar"):
            self.bases.append(name)
        elif type_ == "continuous" and mimic is None and _WHEEL.search(name):
            self.wheels.append(name)
            type_ = "fixed"
        elif limits is not None and limits[0] == limits[1] and mimic is None:
            self.still.append(name)
            type_ = "fixed"
        place = f"{element.file}:{element.line}"
        return UrdfJoint(name, type_, place, ends[0], ends[1], xyz, rpy, direction, limits, effort, velocity, mimic)

    def _tree(
        self, links: Mapping[str, Link], by_name: Mapping[str, tuple[XmlElement, UrdfJoint]], root: XmlElement
    ) -> dict[str, UrdfJoint]:
        """The joints by child link, parents first."""
        above: dict[str, UrdfJoint] = {}
        for element, joint in by_name.values():
            if joint.child in above:
                first = above[joint.child].name
                raise element.error(
                    f"link {joint.child!r} has two parents, by the joints {first!r} and {joint.name!r}; closed chains "
                    "cannot be described by a URDF"
                )
            above[joint.child] = joint
        tops = [name for name in links if name not in above]
        if len(tops) > 1:
            raise root.error(
                f"the links {several(tops)} have no parent, but one tree is needed: join them to {tops[0]!r} by fixed "
                "joints"
            )
        if not tops:
            raise root.error(f"each link has a parent, so the joints form a circle: {several(list(by_name))}")
        below: dict[str, list[UrdfJoint]] = {}
        for joint in above.values():
            below.setdefault(joint.parent, []).append(joint)
        ordered: dict[str, UrdfJoint] = {}
        waiting = [tops[0]]
        while waiting:
            joints = below.get(waiting.pop(), [])
            ordered |= {joint.child: joint for joint in joints}
            waiting += [joint.child for joint in reversed(joints)]
        if circle := [joint.name for joint in above.values() if joint.child not in ordered]:
            raise root.error(f"joints form a circle: {several(circle)}")
        return ordered

    def _mimics(self, joints: dict[str, UrdfJoint], by_name: Mapping[str, tuple[XmlElement, UrdfJoint]]) -> None:
        """Let joints that mimic follow one that mimics none."""
        names = {name: joint for name, (_, joint) in by_name.items()}
        for child, joint in joints.items():
            mimic, passed = joint.mimic, [joint.name]
            if joint.type in _STILL:
                joints[child] = attrs.evolve(joint, mimic=None)
                continue
            while mimic is not None:
                leader = names.get(mimic.joint)
                if leader is None or leader.type in _STILL:
                    reason = (
                        "which is fixed" if leader else f"unknown{did_you_mean(mimic.joint, list(names), 'it has')}"
                    )
                    raise by_name[joint.name][0].error(f"joint {joint.name!r} mimics {mimic.joint!r}, {reason}")
                if leader.name in passed:
                    raise by_name[joint.name][0].error(f"joint {joint.name!r} mimics itself: {' -> '.join(passed)}")
                passed.append(leader.name)
                joints[child] = attrs.evolve(joint, mimic=mimic)
                if leader.mimic is None:
                    break
                factor, offset = leader.mimic.multiplier, leader.mimic.offset
                mimic = Mimic(leader.mimic.joint, mimic.multiplier * factor, mimic.multiplier * offset + mimic.offset)


def _named(root: XmlElement, tag: str) -> dict[str, XmlElement]:
    by_name: dict[str, XmlElement] = {}
    for each in root.children:
        if each.tag != tag:
            continue
        name = each.attributes.get("name", "")
        if not name.strip():
            raise each.error(f"<{tag}> has no name")
        if not name.isprintable():
            raise each.error(f"<{tag}>: its name has characters that cannot be printed: {name!r}")
        if "${" in name:
            raise each.error(f"<{tag}>: its name, {name!r}, has ${{, which begins a variable in a robot YAML")
        if name in by_name:
            raise each.error(f"a second {tag} named {name!r}; the first is in line {by_name[name].line}")
        by_name[name] = each
    return by_name


def _child(element: XmlElement, tag: str) -> XmlElement | None:
    return next((each for each in element.children if each.tag == tag), None)


def _numbers(element: XmlElement, name: str, default: str, count: int) -> tuple[float, ...]:
    numbers = tuple(element.numbers(name, default, count))
    for value in numbers:
        if abs(value) > _MOST:
            raise element.error(f"{name} is {value:g}, must be within -{_MOST:g} to {_MOST:g}")
    return numbers


def _origin(element: XmlElement) -> tuple[tuple[float, ...], tuple[float, ...]]:
    origin = _child(element, "origin")
    if origin is None:
        return (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    return _numbers(origin, "xyz", "0 0 0", 3), _numbers(origin, "rpy", "0 0 0", 3)


def _inertial(link: str, element: XmlElement) -> Inertial | None:
    inertial = _child(element, "inertial")
    if inertial is None:
        return None
    xyz, rpy = _origin(inertial)
    mass = _child(inertial, "mass")
    value = _numbers(mass, "value", "0", 1)[0] if mass is not None else 0.0
    if value < 0:
        raise (mass or inertial).error(f"link {link!r}: its mass is {value:g} kg, must not be below zero")
    tensor = _child(inertial, "inertia")
    if tensor is None:
        return Inertial(value, (), xyz, rpy)
    names = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    return Inertial(value, tuple(_numbers(tensor, name, "0", 1)[0] for name in names), xyz, rpy)


def _mimic(name: str, element: XmlElement) -> Mimic | None:
    mimic = _child(element, "mimic")
    if mimic is None:
        return None
    if not mimic.attributes.get("joint"):
        raise mimic.error(f"joint {name!r}: <mimic> names no joint")
    multiplier, offset = (
        _numbers(mimic, key, default, 1)[0] for key, default in (("multiplier", "1"), ("offset", "0"))
    )
    return Mimic(mimic.attributes["joint"], multiplier, offset)


def _limits(name: str, type_: str, element: XmlElement) -> tuple[tuple[float, float] | None, float, float]:
    """Limits, effort and velocity."""
    if type_ in _STILL:
        return None, 0.0, 0.0
    limit = _child(element, "limit")
    if limit is None:
        if type_ == "prismatic":
            raise element.error(
                f"joint {name!r} slides, and has no limits: add <limit lower=… upper=… effort=… velocity=…/>, in m, N "
                "and m/s"
            )
        return None, 0.0, 0.0
    effort, velocity = (_numbers(limit, key, "0", 1)[0] for key in ("effort", "velocity"))
    for key, value in (("effort", effort), ("velocity", velocity)):
        if value < 0:
            raise limit.error(f"joint {name!r}: its {key} is {value:g}, must not be below zero")
    if type_ == "continuous":
        return None, effort, velocity
    lower, upper = (_numbers(limit, key, "0", 1)[0] for key in ("lower", "upper"))
    if lower > upper:
        raise limit.error(f"joint {name!r}: its lower limit, {lower:g}, is above the upper one, {upper:g}: swap them")
    if type_ == "revolute" and (upper - lower > 2 * _TURNS):
        return None, effort, velocity
    return (lower, upper), effort, velocity

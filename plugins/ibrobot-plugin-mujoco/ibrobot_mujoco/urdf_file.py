"""What the conversion of a URDF or xacro file uses: links with shapes and masses, joints that move, and mimicry.

Every fault is an error that names file, line, value, and what would be right.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path

import attrs
from ibrobot_kinematics.errors import KinematicsError
from ibrobot_kinematics.urdf import Mimic, UrdfJoint, origin_of, urdf_of
from ibrobot_kinematics.xml_file import XmlElement, read_xml

from ibrobot_core.api import HardwareError, did_you_mean
from ibrobot_mujoco.ros_packages import Packages
from ibrobot_mujoco.xacro_file import PLACE, expand_xacro

STILL = ("fixed", "floating", "planar")
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
class Robot:
    """A robot: a tree of links."""

    name: str
    file: Path
    links: Mapping[str, Link]
    joints: Mapping[str, UrdfJoint]
    """Joint by the name of its child link, parents first. Limits are None for joints without an end."""
    root: str
    notes: tuple[str, ...]
    """What was left out, or is used in another way."""


def several(names: list[str]) -> str:
    """A list of names for a note."""
    more = len(names) - _LISTED
    return ", ".join(names[:_LISTED]) + (f" and {more} more" if more > 0 else "")


def read_robot(path: Path, packages: Packages, arguments: Mapping[str, str]) -> Robot:
    """Read a URDF, or expand a xacro file to one.

    Args:
        path: the file.
        packages: where the packages are that it names.
        arguments: values of a xacro file's arguments.

    Raises:
        HardwareError: if it has a fault.
    """
    try:
        return _Reader().read(_root(path, packages, arguments), path)
    except KinematicsError as error:
        raise HardwareError(str(error)) from None


def _root(path: Path, packages: Packages, arguments: Mapping[str, str]) -> XmlElement:
    try:
        text = path.read_bytes()
    except OSError as error:
        raise HardwareError(f"{path}: cannot be read: {error.strerror}") from None
    if b"xacro:" not in text:
        if arguments:
            raise HardwareError(f"{path} is not a xacro file, so it has no argument {next(iter(arguments))!r}")
        return read_xml(path, "robot")
    with tempfile.TemporaryDirectory() as folder:
        expanded = Path(folder) / path.name
        expanded.write_text(expand_xacro(path, packages, arguments), encoding="utf-8")
        return _placed(read_xml(expanded, "robot"), path)


def _placed(element: XmlElement, path: Path) -> XmlElement:
    """The element with the places in the xacro files."""
    file, _, line = element.attributes.get(PLACE, f"{path}:0").rpartition(":")
    children = [_placed(each, path) for each in element.children]
    return XmlElement(element.tag, element.attributes, Path(file), int(line), children)


@attrs.define
class _Reader:
    """Reads one file, and collects what it leaves out."""

    empty: list[str] = attrs.field(factory=list)
    visual: list[str] = attrs.field(factory=list)
    bases: list[str] = attrs.field(factory=list)
    wheels: list[str] = attrs.field(factory=list)
    still: list[str] = attrs.field(factory=list)

    def read(self, root: XmlElement, path: Path) -> Robot:
        urdf = urdf_of(root, path)
        for element in (*urdf.elements.values(), *(joint.element for joint in urdf.joints)):
            _check_name(element)
        links = {name: self._link(name, each) for name, each in urdf.elements.items()}
        if "world" in links and urdf.root != "world":
            raise HardwareError(f"{links['world'].place}: the link 'world' must be the one without a parent joint")
        joints = {joint.child: self._joint(joint, urdf.root) for joint in urdf.outwards}
        self._mimics(joints)
        notes = (
            ("Shapes without any size are left out: {}.", self.empty),
            ("Without collision shapes in the URDF, those for the eye are used: {}.", self.visual),
            ("The base stands still, whatever moves it in the URDF: {}.", self.bases),
            ("Wheels do not turn: {}.", self.wheels),
            ("Fixed, since the upper and the lower limit in the URDF are equal: {}.", self.still),
        )
        texts = tuple(text.format(several(names)) for text, names in notes if names)
        return Robot(urdf.name, path, links, joints, urdf.root, texts)

    def _link(self, name: str, element: XmlElement) -> Link:
        collisions, shown = list(element.tagged("collision")), list(element.tagged("visual"))
        shapes = [shape for each in collisions or shown for shape in self._shapes(name, each)]
        if shapes and not collisions:
            self.visual.append(name)
        place = f"{element.file}:{element.line}"
        return Link(name, place, _inertial(name, element), tuple(shapes))

    def _shapes(self, link: str, element: XmlElement) -> Iterator[Shape]:
        xyz, rpy = _origin(element)
        geometry = element.child("geometry")
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

    def _joint(self, joint: UrdfJoint, root: str) -> UrdfJoint:
        """The joint as it moves here."""
        name, element = joint.name, joint.element
        _origin(element)
        if joint.type in STILL:
            if joint.type != "fixed":
                self.bases.append(name)
                if joint.parent != root:
                    raise element.error(
                        f"joint {name!r} is {joint.type}; only the base may have such a joint: make it fixed, or use a "
                        "URDF without its link"
                    )
            return attrs.evolve(joint, mimic=None)
        joint = attrs.evolve(joint, limits=_limits(joint))
        if joint.type == "continuous" and joint.mimic is None and _WHEEL.search(name):
            self.wheels.append(name)
            return attrs.evolve(joint, type="fixed")
        if joint.limits is not None and joint.limits[0] == joint.limits[1] and joint.mimic is None:
            self.still.append(name)
            return attrs.evolve(joint, type="fixed")
        return joint

    def _mimics(self, joints: dict[str, UrdfJoint]) -> None:
        """Let joints that mimic follow one that mimics none."""
        names = {joint.name: joint for joint in joints.values()}
        for child, joint in joints.items():
            mimic, passed = joint.mimic, [joint.name]
            while mimic is not None:
                leader = names.get(mimic.joint)
                if leader is None or leader.type in STILL:
                    reason = (
                        "which is fixed" if leader else f"unknown{did_you_mean(mimic.joint, list(names), 'it has')}"
                    )
                    raise joint.element.error(f"joint {joint.name!r} mimics {mimic.joint!r}, {reason}")
                if leader.name in passed:
                    raise joint.element.error(f"joint {joint.name!r} mimics itself: {' -> '.join(passed)}")
                passed.append(leader.name)
                joints[child] = attrs.evolve(joint, mimic=mimic)
                if leader.mimic is None:
                    break
                factor, offset = leader.mimic.multiplier, leader.mimic.offset
                mimic = Mimic(leader.mimic.joint, mimic.multiplier * factor, mimic.multiplier * offset + mimic.offset)


def _check_name(element: XmlElement) -> None:
    name = element.attributes["name"]
    if not name.isprintable():
        raise element.error(f"<{element.tag}>: its name has characters that cannot be printed: {name!r}")
    if "${" in name:
        raise element.error(f"<{element.tag}>: its name, {name!r}, has ${{, which begins a variable in a robot YAML")


def _numbers(element: XmlElement, name: str, default: str, count: int) -> tuple[float, ...]:
    numbers = element.numbers(name, default, count)
    for value in numbers:
        if abs(value) > _MOST:
            raise element.error(f"{name} is {value:g}, must be within -{_MOST:g} to {_MOST:g}")
    return numbers


def _origin(element: XmlElement) -> tuple[tuple[float, ...], tuple[float, ...]]:
    origin = element.child("origin")
    if origin is not None:
        for name in ("xyz", "rpy"):
            _numbers(origin, name, "0 0 0", 3)
    return origin_of(element)


def _inertial(link: str, element: XmlElement) -> Inertial | None:
    inertial = element.child("inertial")
    if inertial is None:
        return None
    xyz, rpy = _origin(inertial)
    mass = inertial.child("mass")
    value = _numbers(mass, "value", "0", 1)[0] if mass is not None else 0.0
    if value < 0:
        raise (mass or inertial).error(f"link {link!r}: its mass is {value:g} kg, must not be below zero")
    tensor = inertial.child("inertia")
    if tensor is None:
        return Inertial(value, (), xyz, rpy)
    names = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    return Inertial(value, tuple(_numbers(tensor, name, "0", 1)[0] for name in names), xyz, rpy)


def _limits(joint: UrdfJoint) -> tuple[float, float] | None:
    """The limits of a moving joint; None if it has no end."""
    name, limit = joint.name, joint.element.child("limit")
    if limit is None:
        if joint.type == "prismatic":
            raise joint.element.error(
                f"joint {name!r} slides, and has no limits: add <limit lower=… upper=… effort=… velocity=…/>, in m, N "
                "and m/s"
            )
        return None
    for key in ("lower", "upper", "effort", "velocity"):
        _numbers(limit, key, "0", 1)
    for key, value in (("effort", joint.effort), ("velocity", joint.velocity)):
        if value < 0:
            raise limit.error(f"joint {name!r}: its {key} is {value:g}, must not be below zero")
    if joint.limits is None:
        return None
    lower, upper = joint.limits
    if lower > upper:
        raise limit.error(f"joint {name!r}: its lower limit, {lower:g}, is above the upper one, {upper:g}: swap them")
    return None if joint.type == "revolute" and upper - lower > 2 * _TURNS else (lower, upper)

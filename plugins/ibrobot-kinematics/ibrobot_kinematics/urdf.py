"""URDF files: links, joints, and their tree. Source: http://wiki.ros.org/urdf/XML."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from functools import cached_property
from pathlib import Path

import attrs

from ibrobot_core.api import did_you_mean
from ibrobot_kinematics.read_once import read_once
from ibrobot_kinematics.xml_file import XmlElement, read_xml

MOVING = ("revolute", "continuous", "prismatic")
"""Types of joints with one degree of freedom."""
_TYPES = (*MOVING, "fixed", "floating", "planar")
_NO_LENGTH = 1e-6
"""Axes that are shorter determine no direction."""

Triple = tuple[float, float, float]


@attrs.frozen
class Mimic:
    """A joint follows another one: multiplier * joint + offset."""

    joint: str
    multiplier: float
    offset: float


@attrs.frozen
class UrdfJoint:
    """A joint between a parent and a child link."""

    name: str
    type: str
    """E.g. `revolute`, `prismatic` or `fixed`."""
    parent: str
    child: str
    xyz: Triple
    """Origin of the child in the parent frame, at position 0 [m]."""
    rpy: Triple
    """Roll, pitch and yaw of the child about the fixed axes of the parent, at position 0 [rad]."""
    axis: Triple
    """Axis of the joint in the child's frame, of length 1."""
    limits: tuple[float, float] | None
    """Lower and upper limit [rad or m]; None without `<limit>`, and for joints that have none by their type."""
    effort: float
    """[N m or N]; 0 without `<limit>`."""
    velocity: float
    """[rad/s or m/s]; 0 without `<limit>`."""
    mimic: Mimic | None
    element: XmlElement = attrs.field(repr=False, eq=False)


@attrs.frozen(slots=False)
class Urdf:
    """A URDF whose links form one tree."""

    path: Path
    name: str
    elements: Mapping[str, XmlElement] = attrs.field(repr=False, eq=False)
    """Link -> its element, in file order."""
    joints: tuple[UrdfJoint, ...]
    """In file order."""
    root: str
    """The link without a parent joint."""

    @cached_property
    def links(self) -> tuple[str, ...]:
        """The names of the links, in file order."""
        return tuple(self.elements)

    @cached_property
    def carriers(self) -> Mapping[str, UrdfJoint]:
        """Link -> the joint whose child it is; without the root."""
        return {joint.child: joint for joint in self.joints}

    @cached_property
    def outwards(self) -> tuple[UrdfJoint, ...]:
        """The joints from the root outwards: parents come first."""
        below: dict[str, list[UrdfJoint]] = {}
        for joint in self.joints:
            below.setdefault(joint.parent, []).append(joint)
        ordered: list[UrdfJoint] = []
        waiting = [self.root]
        while waiting:
            joints = below.get(waiting.pop(), [])
            ordered += joints
            waiting += [joint.child for joint in reversed(joints)]
        return tuple(ordered)

    def chain(self, base: str, tip: str) -> tuple[UrdfJoint, ...] | None:
        """The joints from one link outwards to another, fixed ones included; None if there is no such way."""
        joints: list[UrdfJoint] = []
        while tip != base:
            if tip not in self.carriers:
                return None
            joints.append(self.carriers[tip])
            tip = joints[-1].parent
        return tuple(reversed(joints))


@read_once(lambda urdf: (urdf.path,))
def read_urdf(path: Path) -> Urdf:
    """Read a URDF.

    Raises:
        KinematicsError: if it cannot be read, is not a URDF, or its links form no single tree; gives file and line.
    """
    return urdf_of(read_xml(path, "robot"), path)


def urdf_of(root: XmlElement, path: Path) -> Urdf:
    """The URDF with this root element, e.g. of an expanded xacro file.

    Raises:
        KinematicsError: as `read_urdf`.
    """
    _refuse_xacro(root)
    elements = _named(root, "link")
    if not elements:
        raise root.error("has no <link>; a xacro file that only defines macros is included by another one: give that")
    joints = tuple(_joint(element, elements) for element in _named(root, "joint").values())
    return Urdf(path, root.attributes.get("name", ""), elements, joints, _root_link(elements, joints))


def _refuse_xacro(root: XmlElement) -> None:
    for element in root.below():
        if element.tag.startswith("xacro:"):
            raise element.error(f"<{element.tag}> is xacro; expand the file first: xacro {root.file.name} > FILE")


def _named(root: XmlElement, tag: str) -> dict[str, XmlElement]:
    by_name: dict[str, XmlElement] = {}
    for element in root.tagged(tag):
        name = element.required("name")
        if name in by_name:
            raise element.error(f"a second {tag} named {name!r}, first in line {by_name[name].line}")
        by_name[name] = element
    return by_name


def _joint(element: XmlElement, links: Mapping[str, XmlElement]) -> UrdfJoint:
    name, kind = element.required("name"), element.required("type")
    if kind not in _TYPES:
        raise element.error(f"joint {name!r}: unknown type {kind!r}{did_you_mean(kind, _TYPES, 'known')}")
    ends = []
    for side in ("parent", "child"):
        end = element.child(side)
        if end is None:
            raise element.error(f"joint {name!r} has no <{side} link=…/>")
        link = end.required("link")
        if link not in links:
            raise end.error(f"joint {name!r}: unknown link {link!r}{did_you_mean(link, list(links), 'known')}")
        ends.append(link)
    axis = element.child("axis")
    x, y, z = axis.numbers("xyz", "1 0 0", 3) if axis is not None else (1.0, 0.0, 0.0)
    length = math.hypot(x, y, z)
    if length < _NO_LENGTH:
        if kind in MOVING:
            raise (axis or element).error(f"joint {name!r}: its axis is zero, must have a direction, e.g. 0 0 1")
        x, y, z, length = 1.0, 0.0, 0.0, 1.0
    limit = element.child("limit") if kind in MOVING else None
    lower, upper, effort, velocity = _numbers(limit, ("lower", "upper", "effort", "velocity"))
    limits = (lower, upper) if limit is not None and kind != "continuous" else None
    xyz, rpy = origin_of(element)
    return UrdfJoint(
        name, kind, ends[0], ends[1], xyz, rpy, (x / length, y / length, z / length), limits, effort, velocity,
        _mimic(name, element.child("mimic")), element,
    )  # fmt: skip


def origin_of(element: XmlElement) -> tuple[Triple, Triple]:
    """Position [m], and roll, pitch and yaw [rad], of the origin in an element; zeros without one."""
    origin = element.child("origin")
    if origin is None:
        return (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    (x, y, z), (roll, pitch, yaw) = (origin.numbers(each, "0 0 0", 3) for each in ("xyz", "rpy"))
    return (x, y, z), (roll, pitch, yaw)


def _numbers(element: XmlElement | None, names: tuple[str, ...]) -> Iterator[float]:
    return (0.0 if element is None else element.numbers(name, "0", 1)[0] for name in names)


def _mimic(name: str, element: XmlElement | None) -> Mimic | None:
    if element is None:
        return None
    joint = element.attributes.get("joint", "")
    if not joint:
        raise element.error(f"joint {name!r}: <mimic> names no joint")
    return Mimic(joint, element.numbers("multiplier", "1", 1)[0], element.numbers("offset", "0", 1)[0])


def _root_link(links: Mapping[str, XmlElement], joints: tuple[UrdfJoint, ...]) -> str:
    """The root of the tree of links.

    Raises:
        KinematicsError: if they do not form one tree.
    """
    carriers: dict[str, UrdfJoint] = {}
    for joint in joints:
        if (other := carriers.setdefault(joint.child, joint)) is not joint:
            raise joint.element.error(
                f"joints {other.name!r} (line {other.element.line}) and {joint.name!r} both carry link "
                f"{joint.child!r}; links must form a tree"
            )
    roots = [link for link in links if link not in carriers]
    for link, joint in carriers.items():
        seen = [link]
        while (parent := carriers[seen[-1]].parent) in carriers:
            seen.append(parent)
            if parent == link:
                loop = " -> ".join(reversed(seen))
                raise joint.element.error(f"link {link!r} is its own ancestor: {loop}; links must form a tree")
            if len(seen) > len(links):
                break  # a loop of its ancestors, reported for these
    if len(roots) > 1:
        reason = f"link {roots[1]!r} is not connected: no joint leads to it from {roots[0]!r}"
        raise links[roots[1]].error(f"{reason}; links must form a tree: join them by a fixed joint")
    return roots[0]

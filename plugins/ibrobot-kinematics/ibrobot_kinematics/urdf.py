"""URDF files: links, joints, and their tree. Source: http://wiki.ros.org/urdf/XML."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path

import attrs

from ibrobot_core.api import did_you_mean
from ibrobot_core.app import ModelError, XmlElement, read_xml
from ibrobot_kinematics.errors import KinematicsError

MOVING = ("revolute", "continuous", "prismatic")
"""Types of joints with one degree of freedom."""
_TYPES = (*MOVING, "fixed", "floating", "planar")

Triple = tuple[float, float, float]


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
    line: int
    """Its line in the file."""


@attrs.frozen(slots=False)
class Urdf:
    """A URDF whose links form one tree."""

    path: Path
    name: str
    links: tuple[str, ...]
    """In file order."""
    joints: tuple[UrdfJoint, ...]
    """In file order."""
    root: str
    """The link without a parent joint."""

    @cached_property
    def carriers(self) -> Mapping[str, UrdfJoint]:
        """Link -> the joint whose child it is; without the root."""
        return {joint.child: joint for joint in self.joints}

    def chain(self, base: str, tip: str) -> tuple[UrdfJoint, ...] | None:
        """The joints from one link outwards to another, fixed ones included; None if there is no such way."""
        joints: list[UrdfJoint] = []
        while tip != base:
            if tip not in self.carriers:
                return None
            joints.append(self.carriers[tip])
            tip = joints[-1].parent
        return tuple(reversed(joints))


def read_urdf(path: Path) -> Urdf:
    """Read a URDF.

    Raises:
        KinematicsError: if it cannot be read, is not a URDF, or its links form no single tree; gives file and line.
    """
    try:
        root = read_xml(path, "robot")
        _refuse_xacro(root)
        elements: dict[str, XmlElement] = {}
        for element in root.children:
            if element.tag == "link":
                name = required(element, "name")
                if name in elements:
                    raise element.error(f"a second link named {name!r}, first in line {elements[name].line}")
                elements[name] = element
        if not elements:
            raise root.error("has no link")
        joints: dict[str, UrdfJoint] = {}
        for element in root.children:
            if element.tag == "joint":
                joint = _joint(element, list(elements))
                if joint.name in joints:
                    raise element.error(f"a second joint named {joint.name!r}, first in line {joints[joint.name].line}")
                joints[joint.name] = joint
        links = {name: element.line for name, element in elements.items()}
        base = _tree(path, links, tuple(joints.values()))
        return Urdf(path, root.attributes.get("name", ""), tuple(elements), tuple(joints.values()), base)
    except ModelError as error:
        raise KinematicsError(str(error)) from None


def required(element: XmlElement, attribute: str) -> str:
    """An attribute that an element must have.

    Raises:
        ModelError: if it is missing or empty.
    """
    value = element.attributes.get(attribute, "").strip()
    if not value:
        raise element.error(f"<{element.tag}> has no {attribute}")
    return value


def _refuse_xacro(root: XmlElement) -> None:
    for element in root.below():
        if element.tag.startswith("xacro:"):
            raise element.error(f"<{element.tag}> is xacro; expand the file first: xacro {root.file.name} > FILE")


def _joint(element: XmlElement, links: list[str]) -> UrdfJoint:
    name, kind = required(element, "name"), required(element, "type")
    if kind not in _TYPES:
        raise element.error(f"joint {name!r}: unknown type {kind!r}{did_you_mean(kind, _TYPES, 'known')}")
    parts = {child.tag: child for child in element.children}
    ends = []
    for end in ("parent", "child"):
        if end not in parts:
            raise element.error(f"joint {name!r} has no {end}")
        link = required(parts[end], "link")
        if link not in links:
            raise parts[end].error(f"joint {name!r}: unknown link {link!r}{did_you_mean(link, links, 'known')}")
        ends.append(link)
    nothing = XmlElement("", {}, element.file, element.line)
    origin, axis = parts.get("origin", nothing), parts.get("axis", nothing)
    x, y, z = axis.numbers("xyz", "1 0 0", 3)
    length = (x * x + y * y + z * z) ** 0.5
    if length == 0:
        if kind in MOVING:
            raise axis.error(f"joint {name!r}: its axis has length 0")
        x, length = 1.0, 1.0
    return UrdfJoint(
        name, kind, ends[0], ends[1], _triple(origin, "xyz"), _triple(origin, "rpy"),
        (x / length, y / length, z / length), element.line,
    )  # fmt: skip


def _triple(element: XmlElement, attribute: str) -> Triple:
    x, y, z = element.numbers(attribute, "0 0 0", 3)
    return x, y, z


def _tree(path: Path, links: Mapping[str, int], joints: tuple[UrdfJoint, ...]) -> str:
    """The root of the tree of links.

    Args:
        path: the file.
        links: link -> line.
        joints: the joints of the file.

    Raises:
        ModelError: if they do not form one tree.
    """
    carriers: dict[str, UrdfJoint] = {}
    for joint in joints:
        if (other := carriers.setdefault(joint.child, joint)) is not joint:
            reason = f"joints {other.name!r} (line {other.line}) and {joint.name!r} both carry link {joint.child!r}"
            raise ModelError(f"{path}:{joint.line}: {reason}; links must form a tree")
    roots = [link for link in links if link not in carriers]
    for link, joint in carriers.items():
        seen = [link]
        while (parent := carriers[seen[-1]].parent) in carriers:
            seen.append(parent)
            if parent == link:
                loop = " -> ".join(reversed(seen))
                raise ModelError(
                    f"{path}:{joint.line}: link {link!r} is its own ancestor: {loop}; links must form a tree"
                )
            if len(seen) > len(links):
                break  # a loop of its ancestors, reported for these
    if len(roots) > 1:
        place = f"{path}:{links[roots[1]]}"
        raise ModelError(f"{place}: link {roots[1]!r} is not connected: no joint leads to it from {roots[0]!r}")
    return roots[0]

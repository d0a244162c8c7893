"""SRDF files: groups, named poses, and pairs of links that may touch. Source: http://wiki.ros.org/srdf."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path

import attrs

from ibrobot_core.api import did_you_mean
from ibrobot_kinematics.urdf import MOVING, Urdf
from ibrobot_kinematics.xml_file import XmlElement, read_xml

_ELEMENTS = (
    "group", "group_state", "disable_collisions", "enable_collisions", "disable_default_collisions", "end_effector",
    "virtual_joint", "passive_joint", "link_sphere_approximation", "joint_property",
)  # fmt: skip
"""The elements that MoveIt knows."""
_LIKELY = 0.8
"""Unknown elements more similar to a known one are taken for misspelt."""


@attrs.frozen
class GroupState:
    """A named pose of a group."""

    name: str
    group: str
    positions: Mapping[str, float]
    """Joint -> position [rad or m], of the joints that the file names."""


@attrs.frozen
class Srdf:
    """What an SRDF adds to a URDF."""

    path: Path
    name: str
    groups: Mapping[str, tuple[str, ...]]
    """Group -> its moving joints, without repetition, in the order of the file; chains from the base outwards."""
    states: tuple[GroupState, ...]
    """In file order; a name is unique within its group."""
    may_touch: frozenset[tuple[str, str]]
    """Pairs of links whose collisions do not count, both names in alphabetical order."""


def read_srdf(path: Path, urdf: Urdf) -> Srdf:
    """Read an SRDF.

    Args:
        path: the file.
        urdf: the robot's URDF, whose links and joints it names.

    Raises:
        KinematicsError: if it cannot be read, is not an SRDF, or has a name that the URDF lacks; gives file and line.
    """
    root = read_xml(path, "robot")
    for element in root.children:
        _check_tag(element, _ELEMENTS)
    groups = _Groups(urdf, {})
    for element in root.tagged("group"):
        name = element.required("name")
        if (other := groups.elements.get(name)) is not None:
            raise element.error(f"a second group named {name!r}, first in line {other.line}")
        groups.elements[name] = element
    joints = {name: groups.joints(name) for name in groups.elements}
    states = tuple(_states(root, urdf, joints))
    return Srdf(path, root.attributes.get("name", ""), joints, states, _may_touch(root, urdf))


def _check_tag(element: XmlElement, known: Sequence[str]) -> None:
    """Refuse an element that looks like a misspelt one; others belong to other programs."""
    if element.tag.startswith("xacro:"):
        raise element.error(f"<{element.tag}> is xacro; expand the file first: xacro {element.file.name} > FILE")
    if element.tag not in known and (close := get_close_matches(element.tag, known, 1, _LIKELY)):
        raise element.error(f"unknown element <{element.tag}>, did you mean <{close[0]}>?")


def _known(element: XmlElement, attribute: str, known: Sequence[str], what: str) -> str:
    """An attribute that must be one of some names."""
    name = element.required(attribute)
    if name not in known:
        raise element.error(f"unknown {what} {name!r}{did_you_mean(name, known, 'known')}")
    return name


@attrs.frozen
class _Groups:
    """The groups of a file, which consist of joints, links, chains and other groups."""

    urdf: Urdf
    elements: dict[str, XmlElement]

    def joints(self, name: str, within: tuple[str, ...] = ()) -> tuple[str, ...]:
        """The moving joints of a group, which is part of the groups `within`."""
        members = [joint for child in self.elements[name].children for joint in self._member(child, (*within, name))]
        return tuple(dict.fromkeys(members))

    def _member(self, element: XmlElement, within: tuple[str, ...]) -> Iterator[str]:
        moving = {joint.name for joint in self.urdf.joints if joint.type in MOVING}
        names = [joint.name for joint in self.urdf.joints]
        match element.tag:
            case "joint":
                members = [_known(element, "name", names, "joint")]
            case "link":  # the joint that carries it, as in MoveIt
                link = _known(element, "name", self.urdf.links, "link")
                members = [self.urdf.carriers[link].name] if link in self.urdf.carriers else []
            case "chain":
                members = self._chain(element)
            case "group":
                inner = _known(element, "name", list(self.elements), "group")
                if inner in within:
                    raise element.error(f"group {inner!r} contains itself: {' -> '.join((*within, inner))}")
                members = list(self.joints(inner, within))
            case _:
                _check_tag(element, ("joint", "link", "chain", "group"))
                members = []
        return (name for name in members if name in moving)

    def _chain(self, element: XmlElement) -> list[str]:
        base, tip = (_known(element, end, self.urdf.links, "link") for end in ("base_link", "tip_link"))
        chain = self.urdf.chain(base, tip)
        if chain is None:
            raise element.error(f"no chain from {base!r} to {tip!r}: it must lead outwards, from the base to the tip")
        return [joint.name for joint in chain]


def _states(root: XmlElement, urdf: Urdf, groups: Mapping[str, tuple[str, ...]]) -> Iterator[GroupState]:
    without_position = {joint.name for joint in urdf.joints if joint.type not in MOVING}
    lines: dict[tuple[str, str], int] = {}
    for element in root.tagged("group_state"):
        name, group = element.required("name"), _known(element, "group", list(groups), "group")
        if (group, name) in lines:
            raise element.error(f"a second pose named {name!r} of group {group!r}, first in line {lines[group, name]}")
        lines[group, name] = element.line
        positions: dict[str, float] = {}
        for joint in element.tagged("joint"):
            of = joint.required("name")
            if of in without_position:  # e.g. the planar joint of a mobile base
                continue
            if of not in groups[group]:
                remark = did_you_mean(of, groups[group], "its joints are")
                raise joint.error(f"pose {name!r}: group {group!r} has no joint {of!r}{remark}")
            if of in positions:
                raise joint.error(f"pose {name!r} gives joint {of!r} twice")
            positions[of] = joint.numbers("value", "", 1)[0]
        if not positions:
            raise element.error(f"pose {name!r} gives no joint a position")
        yield GroupState(name, group, positions)


def _may_touch(root: XmlElement, urdf: Urdf) -> frozenset[tuple[str, str]]:
    """The disabled pairs: enabling a pair overrides a default, disabling it overrides both."""
    pairs: set[tuple[str, str]] = set()
    for element in root.tagged("disable_default_collisions"):
        link = _known(element, "link", urdf.links, "link")
        pairs |= {_pair(link, other) for other in urdf.links if other != link}
    for tag, change in (("enable_collisions", pairs.discard), ("disable_collisions", pairs.add)):
        for element in root.tagged(tag):
            first, second = (_known(element, end, urdf.links, "link") for end in ("link1", "link2"))
            if first == second:
                raise element.error(f"link1 and link2 are both {first!r}; name a pair")
            change(_pair(first, second))
    return frozenset(pairs)


def _pair(first: str, second: str) -> tuple[str, str]:
    return (first, second) if first <= second else (second, first)
